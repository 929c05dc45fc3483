# SPDX-License-Identifier: Apache-2.0
"""
What can't work: the error says what is wrong and what to do, and nothing is left.

Through ``ros2 launch`` where it looks at this computer, and by its deployment otherwise.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import uuid

import pytest

from fogros2 import plan, process
from fogros2.deploy import Launch
from fogros2.errors import FogError
from fogros2.model import MachineSpec
from fogros2.provider.container import root as container_root
from fogros2.store import Store
from rigs.bare_computer import bare_computer
from rigs.launched import launching
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
    return FogROSLaunchDescription([
        CloudNode(machine={machine}, package='fogros2_examples', executable='talker')])
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


@pytest.fixture
def write(tmp_path):
    """Return what writes a launch file of one node on one machine."""
    def make(machine):
        path = tmp_path / 'bad.launch.py'
        path.write_text(LAUNCH.format(machine=machine))
        return path
    return make


@pytest.fixture
def refused(write):
    """Return what launches such a file, which has to fail well, and what it said."""
    def launch(machine, *, wrap=()):
        done = subprocess.run(
            [*wrap, 'ros2', 'launch', str(write(machine))], text=True, timeout=170,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        return one_error(done.returncode, done.stdout)
    return launch


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


def one_error(returncode, text):
    """Return the line of error, and all that was said."""
    assert returncode not in (0, None), text
    assert 'Traceback' not in text
    errors = [line for line in text.splitlines() if '[ERROR]' in line]
    assert len(errors) == 1, text
    return errors[0], text


def container(network):
    return f'ContainerInstance(name={NAME!r}, network={network!r})'


def ssh(computer, **more):
    return fails('ssh', **{
        'host': computer.address, 'user': computer.user, 'key': str(computer.key),
        'host_key': computer.host_key, **more})


def nothing_was_made(text):
    return f'{NAME}: machine' not in text


# -- what this computer lacks -------------------------------------------------------------------

def without(path, script='mount --bind /dev/null "$hidden"'):
    """Return words that run a command in a mount namespace in which ``path`` isn't usable."""
    return ['unshare', '-m', 'sh', '-ec', f'hidden={path}; {script}; exec "$@"', 'sh']


needs_namespaces = pytest.mark.skipif(
    os.geteuid() != 0 or subprocess.run(['unshare', '-m', 'true'],
                                        capture_output=True).returncode != 0,
    reason='needs root, and mount namespaces')


@needs_namespaces
def test_missing_tun_device_is_reported(refused, cloud_network):
    error, text = refused(container(cloud_network), wrap=without(
        '/dev/net', 'mount -t tmpfs none "$hidden"'))
    assert 'there is no /dev/net/tun on this computer' in error and 'modprobe tun' in error
    assert nothing_was_made(text)


@needs_namespaces
def test_root_without_overlay_is_reported(refused, cloud_network):
    # what decides is the file system on which the engine would keep the layers
    error, text = refused(container(cloud_network), wrap=without(
        '/var/lib/containers',
        'mkdir -p "$hidden"; mount -t overlay -o ro,lowerdir=/usr:/etc none "$hidden"'))
    assert "this computer's root can't be overlaid" in error
    assert "image='...'" in error
    assert nothing_was_made(text)


@needs_namespaces
def test_missing_root_is_reported(write, cloud_network):
    # nobody has no home and no password, and may not use sudo
    nobody = ['setpriv', '--reuid=nobody', '--regid=nogroup', '--clear-groups']
    if subprocess.run([*nobody, 'ros2', '--help'], capture_output=True).returncode:
        pytest.skip('needs an interpreter and a ros2 that other users may run')
    with tempfile.TemporaryDirectory(prefix='fogt') as own:
        shutil.chown(own, 'nobody')
        file = shutil.copy(write(container(cloud_network)), own)
        done = subprocess.run(
            [*nobody, 'ros2', 'launch', file], text=True, timeout=60, cwd=own,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env={**os.environ, 'HOME': own, 'ROS_LOG_DIR': own, 'FOGROS2_STATE_HOME': own})
    error, text = one_error(done.returncode, done.stdout)
    assert 'a VPN interface needs root' in error and 'sudo' in error
    assert nothing_was_made(text)


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
        deleted = subprocess.run(['ros2', 'fog', 'delete', NAME, '--yes'], capture_output=True,
                                 text=True, timeout=60)
        assert deleted.returncode == 0, deleted.stderr
    finally:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)


def test_name_of_another_launch_is_refused(refused, cloud_network, write):
    with launching() as start:
        first = start(str(write(container(cloud_network))))
        first.wait_for('process started')
        error, text = refused(container(cloud_network))
        assert f"has the machine '{NAME}'" in error
        assert 'give the machine another name=, or end that launch' in error
        assert first.child.poll() is None and first.errors == []
        first.interrupt()
        assert first.ended() == 0, first.text


def test_name_of_a_foreign_container_is_refused(cloud_network, tmp_path):
    """Somebody else's container is in the way: neither taken over nor removed."""
    with bare_computer(f'fogros2-{NAME}', tmp_path / 'computer', cloud_network) as stranger:
        error, _ = fails('container', network=cloud_network)
        assert f"'{NAME}'" in error and 'already' in error
        stranger.run('true')
