# SPDX-License-Identifier: Apache-2.0
"""
What can't work: the error says what is wrong and what to do, and nothing is left.

Through ``ros2 launch`` where it looks at this computer, and by its deployment otherwise.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
import shutil
import subprocess
import tempfile
import uuid

import pytest

from fogros2 import plan, process
from fogros2.deploy import Launch
from fogros2.errors import FogError
from fogros2.model import MachineSpec
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import root as container_root
from fogros2.store import Store
from rigs.bare_computer import bare_computer
from rigs.sshd import private_sshd

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
NAME = f'bad-{uuid.uuid4().hex[:6]}'

LAUNCH = """\
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    return FogROSLaunchDescription([CloudNode(
        machine=ContainerInstance(name={name!r}, network={network!r}),
        package='fogros2_examples', executable='talker')])
"""


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """Give the robot a home of its own: no known hosts, no keys."""
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.delenv('SSH_AUTH_SOCK', raising=False)


@pytest.fixture(scope='module')
def computer(cloud_network, tmp_path_factory):
    """Run a computer that has the robot's environment, reached by SSH."""
    with bare_computer(f'fogt-{NAME}', tmp_path_factory.mktemp('computer'), cloud_network,
                       mounts=container_root.environment_mounts(None)) as running:
        yield running


def fails(provider, **options):
    """Bring a machine up, which has to fail; return the error, and the steps that began."""
    steps = []
    launch = Launch(report=lambda event: steps.append(event.step))
    try:
        with pytest.raises(FogError) as caught:
            launch.up(MachineSpec(NAME, provider, options))
    finally:
        assert launch.down() == []
    return str(caught.value), steps


def ssh(computer, **more):
    return fails('ssh', **{
        'host': computer.address, 'user': computer.user, 'key': str(computer.key),
        'host_key': computer.host_key, **more})


# -- what this computer lacks -------------------------------------------------------------------

@pytest.mark.skipif(os.geteuid() != 0, reason='needs root, to run as somebody without sudo')
def test_missing_root_is_reported(cloud_network):
    # nobody has no home and no password, and may not use sudo
    nobody = ['setpriv', '--reuid=nobody', '--regid=nogroup', '--clear-groups']
    if subprocess.run([*nobody, 'ros2', '--help'], capture_output=True).returncode:
        pytest.skip('needs an interpreter and a ros2 that other users may run')
    with tempfile.TemporaryDirectory(prefix='fogt') as own:
        shutil.chown(own, 'nobody')
        file = Path(own, 'bad.launch.py')
        file.write_text(LAUNCH.format(name=NAME, network=cloud_network))
        done = subprocess.run(
            [*nobody, 'ros2', 'launch', str(file)], text=True, timeout=60, cwd=own,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env={**os.environ, 'HOME': own, 'ROS_LOG_DIR': own, 'FOGROS2_STATE_HOME': own})
    assert done.returncode not in (0, None) and 'Traceback' not in done.stdout, done.stdout
    error, = (line for line in done.stdout.splitlines() if '[ERROR]' in line)
    assert 'a VPN interface needs root' in error and 'sudo' in error
    assert f'{NAME}: machine' not in done.stdout, 'nothing was made'


# -- computers that exist already ---------------------------------------------------------------

def test_unreachable_host_is_reported(computer, nobody):
    error, _ = ssh(computer, host=nobody)
    assert f'{nobody} port 22 does not answer' in error and 'is it on' in error


def test_unknown_host_key_is_refused(computer):
    error, steps = ssh(computer, host_key=None)
    assert f"the host key of '{NAME}' ({computer.address}) is unknown" in error
    assert f'known_hosts: {computer.address} {computer.host_key}' in error
    assert 'watchdog' not in steps


@pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)')
def test_robot_is_refused_as_its_own_machine(root_at_login, tmp_path):
    """Its two ends of the VPN would be in one network, where nothing goes through a VPN."""
    with private_sshd(tmp_path / 'sshd') as server:
        error, _ = fails('ssh', host='localhost', user=server.endpoint.user, port=server.port,
                         key=server.endpoint.key_file, host_key=server.host_key)
    assert f"'{NAME}' is this robot itself" in error
    assert f'--machine {NAME}=robot' in error


@contextlib.contextmanager
def occupied(computer, port):
    """Have somebody on the computer listen on a UDP port."""
    code = (f'import signal, socket; s = socket.socket(type=socket.SOCK_DGRAM); '
            f's.bind(("", {port})); open("/tmp/busy", "w").close(); signal.pause()')
    computer.run(f"rm -f /tmp/busy; python3 -c '{code}' >/dev/null 2>&1 & echo $! >/tmp/pid; "
                 'until [ -e /tmp/busy ]; do :; done')
    try:
        yield
    finally:
        computer.run('kill $(cat /tmp/pid)')


def test_busy_ports_of_a_host_are_reported(computer, monkeypatch):
    with occupied(computer, 7399):
        error, _ = ssh(computer)
    assert 'UDP port 7399' in error and 'in use already' in error and 'ss -lunp' in error
    monkeypatch.setattr(plan, 'machine_port', lambda launch_id: 51999)
    with occupied(computer, 51999):
        error, _ = ssh(computer)
    assert 'UDP port 51999' in error and 'in use already' in error and 'launch again' in error


# -- what is there already ----------------------------------------------------------------------

def test_damaged_record_is_reported(cloud_network):
    folder = Store().machine(NAME)
    folder.mkdir(parents=True)
    (folder / 'record.json').write_text('{"name": ')
    try:
        error, _ = fails('container', network=cloud_network)
        assert f'{folder}/record.json is damaged' in error
        assert f'ros2 fog delete {NAME}' in error
        deleted = subprocess.run(['ros2', 'fog', 'delete', NAME, '--yes', '--force'],
                                 capture_output=True, text=True, timeout=60)
        assert deleted.returncode == 0, deleted.stderr
    finally:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)


def test_name_of_a_foreign_container_is_refused(cloud_network, tmp_path):
    """Somebody else's container is in the way: neither taken over nor removed."""
    podman, stranger = container_engine.named('podman'), f'fogros2-{NAME}'
    try:
        podman.call('create', '--name', stranger, *container_engine.limits(), '--network', 'none',
                    '--rootfs', str(tmp_path), 'true', what='create a container')
        error, _ = fails('container', network=cloud_network)
        assert f"'{NAME}'" in error and 'already' in error
        podman.call('container', 'exists', stranger, what='look for it')
    finally:
        podman.call('rm', '-f', stranger, what='remove it', check=False)
