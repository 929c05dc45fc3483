# SPDX-License-Identifier: Apache-2.0
"""
The robot's image of ``packaging/Dockerfile``, built and run by podman.

Its base is a Debian system that is made here; ROS 2 comes from its wheels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import uuid

import pytest

from fogros2.errors import PrerequisiteError
from fogros2.model import Command, Result
from fogros2.process import run, which
from fogros2.provider.container import engine as container_engine
from rigs.cluster import images

ROOT = Path(__file__).resolve().parents[2]
#: Settings of this computer by which its programs reach package indexes.
SETTINGS = ('/etc/ssl/certs/ca-certificates.crt', '/etc/pip.conf')
#: Words of apt-get and pip where no index can be reached.
OFFLINE = ('Temporary failure resolving', 'Could not connect', 'Failed to establish')
#: A talker and a listener on the robot; the launch ends when a message is heard.
LAUNCH = '''\
from launch import LaunchDescription
from launch.actions import RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessIO
from launch_ros.actions import Node


def generate_launch_description():
    listener = Node(package='fogros2_examples', executable='listener', output='screen')

    def heard(event):
        return Shutdown(reason='heard') if b'I heard' in event.text else None

    return LaunchDescription([
        RegisterEventHandler(OnProcessIO(
            target_action=listener, on_stdout=heard, on_stderr=heard)),
        Node(package='fogros2_examples', executable='talker'), listener])
'''

#: Imports the libraries of the clouds, prints what the image has, and runs the launch.
LOOK = """
python -c 'import azure.identity, boto3, google.auth, kubernetes; print("providers of all clouds")'
ros2 fog doctor || :
exec ros2 launch /mnt/two.launch.py
"""


@pytest.fixture
def podman(engine: str) -> Callable[..., Result]:
    """Return a function that runs podman."""
    def call(*words: str, check: bool = True, timeout: float = 120.0) -> Result:
        return run(Command((engine, *words), sudo=True), timeout=timeout, check=check)
    return call


@pytest.fixture
def base(podman: Callable[..., Result], tmp_path: Path) -> Iterator[str]:
    """Return an image of a Debian system."""
    if which('debootstrap') is None:
        pytest.skip('needs debootstrap')
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2/kubernetes')
    name = f'localhost/fogros2-base:{uuid.uuid4().hex[:8]}'
    layer = tmp_path / 'layer.tar'
    try:
        with images.alone(cache):
            images.pack(layer, images.base(cache, print))
    except PrerequisiteError as error:
        pytest.skip(str(error))
    changes = ['ENV PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin']
    if 'PIP_CERT' in os.environ:
        changes.append(f'ENV PIP_CERT={SETTINGS[0]}')
    podman('import', '-q', *(word for each in changes for word in ('-c', each)), str(layer), name)
    layer.unlink()
    yield name
    podman('rmi', '-f', name)


def test_dockerfile_takes_the_sources_alone(
    podman: Callable[..., Result], tmp_path: Path,
) -> None:
    copy = 'COPY . /opt/fogros2\n'
    assert copy in (ROOT / 'packaging/Dockerfile').read_text()
    file, name = tmp_path / 'Dockerfile', f'localhost/fogros2-sources:{uuid.uuid4().hex[:8]}'
    file.write_text(f'FROM scratch\n{copy}')
    podman('build', '-q', '-t', name, '-f', str(file), str(ROOT))
    try:
        folder = podman('image', 'mount', name).stdout.strip()
        copied = run(Command(('ls', '-A', f'{folder}/opt/fogros2'), sudo=True),
                     timeout=30.0).stdout
        podman('image', 'unmount', name)
    finally:
        podman('rmi', '-f', name)
    packages = {path.parent.name for path in ROOT.glob('*/__init__.py')} - {'test'}
    assert set(copied.split()) == {
        'LICENSE', 'README.md', 'package.xml', 'pyproject.toml', 'setup.cfg', 'setup.py', 'launch',
        'packaging', 'resource', 'ros2_embedded', 'tools', *packages}


@pytest.mark.soak  # minutes, most of them of the package indexes
@pytest.mark.timeout(1800)
def test_image_of_the_robot_runs_launches(
    podman: Callable[..., Result], base: str, tmp_path: Path,
) -> None:
    name = base.replace('-base', '-robot')
    mounts = [word for path in SETTINGS if Path(path).exists()
              for word in ('-v', f'{path}:{path}:ro')]
    (tmp_path / 'two.launch.py').write_text(LAUNCH)
    try:
        built = podman(
            'build', '--network', 'host', '--layers=false', '--force-rm', *mounts,
            '--build-arg', f'BASE={base}', '-t', name, '-f', str(ROOT / 'packaging/Dockerfile'),
            str(ROOT), timeout=1500.0, check=False)
        said = built.stdout[-4000:] + built.stderr[-4000:]
        if built.returncode and any(words in said for words in OFFLINE):
            pytest.skip('needs package indexes')
        assert built.returncode == 0, said
        said = podman(
            'run', '--rm', '--network', 'none', *container_engine.limits(), '-v',
            f'{tmp_path}:/mnt:ro', '--cap-add', 'NET_ADMIN', '--device', '/dev/net/tun', name,
            'sh', '-ec', LOOK).stdout
    finally:
        podman('rmi', '-f', name, check=False)
    assert 'providers of all clouds' in said
    for check in ('Python packages', 'programs', 'root', 'TUN', 'WireGuard', 'nftables'):
        assert f'[ ok ] {check}: ' in said, said
    assert 'I heard' in said
