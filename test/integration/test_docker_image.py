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

pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope='module')
def podman(engine: str) -> Callable[..., Result]:
    """Return a function that runs podman."""
    def call(*words: str, check: bool = True, timeout: float = 120.0) -> Result:
        return run(Command((engine, *words), sudo=True), timeout=timeout, check=check)
    return call


@pytest.fixture(scope='module')
def base(podman: Callable[..., Result], tmp_path_factory: pytest.TempPathFactory,
         ) -> Iterator[str]:
    """Return an image of a Debian system."""
    if which('debootstrap') is None:
        pytest.skip('needs debootstrap')
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2/kubernetes')
    name = f'localhost/fogros2-base:{uuid.uuid4().hex[:8]}'
    layer = tmp_path_factory.mktemp('base') / 'layer.tar'
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
    left = [podman('images', '-a').stdout,
            podman('ps', '-a', '--external', '--format', '{{.Image}} {{.Names}}').stdout]
    assert name.partition(':')[2] not in ' '.join(left)


@pytest.fixture(scope='module')
def robot(podman: Callable[..., Result], base: str) -> Iterator[Callable[..., str]]:
    """Build the image; return a function that runs a command in it, without a network."""
    name = base.replace('-base', '-robot')
    mounts = [word for path in SETTINGS if Path(path).exists()
              for word in ('-v', f'{path}:{path}:ro')]
    try:
        built = podman(
            'build', '--network', 'host', '--layers=false', '--force-rm', *mounts,
            '--build-arg', f'BASE={base}', '-t', name, '-f', str(ROOT / 'packaging/Dockerfile'),
            str(ROOT), timeout=1500.0, check=False)
        said = built.stdout[-4000:] + built.stderr[-4000:]
        if built.returncode and any(words in said for words in OFFLINE):
            pytest.skip('needs package indexes')
        assert built.returncode == 0, said

        def call(*words: str, options: tuple[str, ...] = ()) -> str:
            return podman('run', '--rm', '--network', 'none', *container_engine.limits(),
                          *options, name, *words).stdout

        yield call
    finally:
        podman('rmi', '-f', name, check=False)


def test_image_runs_nodes_of_a_launch(robot: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / 'two.launch.py').write_text(LAUNCH)
    said = robot('ros2', 'launch', '/mnt/two.launch.py', options=('-v', f'{tmp_path}:/mnt:ro'))
    assert 'I heard' in said


def test_image_has_what_launches_on_machines_need(robot: Callable[..., str]) -> None:
    said = robot('sh', '-c', 'ros2 fog doctor || :',
                 options=('--cap-add', 'NET_ADMIN', '--device', '/dev/net/tun'))
    for check in ('Python packages', 'programs', 'root', 'TUN', 'WireGuard', 'nftables'):
        assert f'[ ok ] {check}: ' in said, said


def test_image_has_the_providers_of_all_clouds(robot: Callable[..., str]) -> None:
    robot('python', '-c', 'import azure.identity, boto3, google.auth, kubernetes')


def test_image_has_the_sources_alone(robot: Callable[..., str]) -> None:
    packages = {path.parent.name for path in ROOT.glob('*/__init__.py')} - {'test'}
    assert set(robot('ls', '-A', '/opt/fogros2').split()) == {
        '.venv', 'LICENSE', 'README.md', 'package.xml', 'pyproject.toml', 'setup.cfg', 'setup.py',
        'launch', 'packaging', 'resource', 'ros2_embedded', 'tools', *packages}
