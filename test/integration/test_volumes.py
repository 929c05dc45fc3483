# SPDX-License-Identifier: Apache-2.0
"""A volume and a recording that outlive container machines, and what mounts a volume."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import uuid

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.provider.container import engine as container_engine
from fogros2.waiting import wait_until
from fogros2_features import volumes
from rigs.launched import Launched, launching, ros2

pytestmark = [pytest.mark.usefixtures('nothing_left', 'engine')]

LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(
        network='{network}', name='{name}', ros_workspace='', robot_timeout=10,
        volumes={{'{volume}': '/data'}}, record=['/chatter'], fetch_to='{home}')
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', respawn=True,
        output='screen')])
"""


@pytest.fixture
def volume() -> Iterator[str]:
    name = f'models-{uuid.uuid4().hex[:6]}'
    yield name
    process.run(Command(('podman', 'volume', 'rm', '-f', f'fogros2-volume-{name}'), sudo=True),
                timeout=60.0, check=False)


def inside(container: str, script: str) -> str:
    return container_engine.named('podman').call(
        'exec', container, 'sh', '-ec', script, what='look', check=False).stdout.strip()


def launch_file(folder: Path, network: str, name: str, volume: str) -> str:
    path = folder / f'{name}.launch.py'
    path.write_text(LAUNCH.format(
        network=network, name=name, volume=volume, home=folder / 'home'))
    return str(path)


def kill_agent(run: Launched, name: str) -> None:
    """Kill the agent of a machine, whose node starts again."""
    run.said.clear()
    inside(f'fogros2-{name}', 'kill -9 $(cat /run/fogros2/agent.pid)')
    for words in ('its agent died and was started again', 'process started with pid',
                  'Publishing'):
        run.wait_for(words)


def recording_came_home(folder: Path, name: str) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    file, = folder.glob(f'{name}-*/recordings/*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        words = [message.data for *_, message in reader.iter_decoded_messages()]
    assert len(words) >= 3 and all('Hello World' in word for word in words)


def test_volume_and_recording_outlive_a_container(
    tmp_path: Path, cloud_network: str, volume: str,
) -> None:
    pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
    first, second = (f'{name}-{uuid.uuid4().hex[:6]}' for name in ('one', 'two'))
    with launching() as start:
        run = start(launch_file(tmp_path, cloud_network, first, volume))
        run.wait_for('Publishing')
        assert f'{volume} at /data' in run.text
        owner = inside(f'fogros2-{first}', 'stat -c %U /data; echo kept >/data/model')
        assert owner == 'fog'

        other = start(launch_file(tmp_path, cloud_network, second, volume))
        assert other.ended() != 0
        assert f"the machine '{first}' has the volume '{volume}'" in other.text
        listed = ros2('fog', 'volume', 'list')
        assert any(volume in line and first in line for line in listed.stdout.splitlines())
        refused = ros2('fog', 'volume', 'delete', '--yes', volume)
        assert refused.returncode == 1 and f"'{first}' has the volume" in refused.stderr

        kill_agent(run, first)
        run.kill()  # the new agent ends the machine
        wait_until(lambda: inside(f'fogros2-{first}', 'echo runs') != 'runs', timeout=60.0,
                   what='the machine to end')
        again = start(launch_file(tmp_path, cloud_network, second, volume))
        again.wait_for('recording /chatter to ')
        again.said.clear()
        again.wait_for('Publishing', times=8)  # the recorder may find the topic late
        assert inside(f'fogros2-{second}', 'cat /data/model; stat -c %U /data/model') == \
            'kept\nfog'
        again.interrupt()
        assert again.ended() == 0, again.text
    recording_came_home(tmp_path / 'home', second)
    ros2('fog', 'delete', first, '--yes')
    assert ros2('fog', 'gc').returncode == 0
    assert volume in ros2('fog', 'volume', 'list').stdout
    deleted = ros2('fog', 'volume', 'delete', volume, '--yes')
    assert deleted.returncode == 0, deleted.stderr
    assert volume not in ros2('fog', 'volume', 'list').stdout


@pytest.mark.parametrize('content', [b'', b'data of somebody'])
def test_disk_with_data_and_no_file_system_stays(tmp_path: Path, content: bytes) -> None:
    if process.run(Command(('losetup', '-f'), sudo=True), timeout=60.0, check=False).returncode:
        pytest.skip('no loop device')
    disk, path = tmp_path / 'disk', tmp_path / 'data'
    disk.write_bytes(content.ljust(1 << 24, b'\0'))
    interface = f'fogt{uuid.uuid4().hex[:6]}'
    result = process.run(Command(('unshare', '-m', 'sh', '-ec', """
device=$(losetup --show -f "$1")
trap 'umount "$2" 2>/dev/null || :; losetup -d "$device"; rm -f "/run/$3.volume-models"' EXIT
sh -ec "$4" sh models "$2" root "$3" '' "$device"
""", 'sh', str(disk), str(path), interface, volumes._MOUNT), sudo=True), timeout=60.0, check=False)
    if content:
        assert 'the disk has data, but no file system' in result.stderr
        assert disk.read_bytes().startswith(content)
    else:
        assert (result.returncode, result.stdout) == (0, 'new\n'), result.stderr


def test_disk_leaves_the_path_of_a_killed_launch(tmp_path: Path) -> None:
    if process.run(Command(('losetup', '-f'), sudo=True), timeout=60.0, check=False).returncode:
        pytest.skip('no loop device')
    disk, path = tmp_path / 'disk', tmp_path / 'data'
    disk.write_bytes(bytes(1 << 24))
    interface = f'fogt{uuid.uuid4().hex[:6]}'
    result = process.run(Command(('unshare', '-m', 'sh', '-ec', """
device=$(losetup --show -f "$1")
trap 'umount -A "$device"; losetup -d "$device"; rm -f "/run/$3.volume-models"' EXIT
for each in old new new; do sh -ec "$4" sh models "$2/$each" root "$3" '' "$device"; done
findmnt -n -o TARGET -S "$device"
cd "$2/new"
sh -ec "$4" sh models "$2/busy" root "$3" '' "$device"
findmnt -n -o TARGET -S "$device"
cd /
""", 'sh', str(disk), str(path), interface, volumes._MOUNT), sudo=True), timeout=60.0, check=False)
    assert (result.returncode, result.stdout) == (
        0, f'new\n{path}/new\n{path}/busy\n'), result.stderr


@pytest.mark.parametrize(('held', 'error'), [
    ('data', '{}/data has another volume'), ('models', 'another launch uses it')])
def test_volumes_and_paths_have_one_user(tmp_path: Path, held: str, error: str) -> None:
    (tmp_path / held).mkdir()
    result = process.run(Command(  # another launch holds the lock until it has mounted its volume
        ('unshare', '-m', 'flock', str(tmp_path / held), 'sh', '-ec', volumes._MOUNT, 'sh',
         'models', str(tmp_path / 'data'), 'root', 'fogt-none', str(tmp_path / 'models')),
        sudo=True), timeout=60.0, check=False)
    assert (result.returncode, result.stderr) == (1, f'{error.format(tmp_path)}\n')


def test_volume_has_its_locks_until_it_is_unmounted(tmp_path: Path) -> None:
    path, programs, name = tmp_path / 'data', tmp_path / 'bin', f'models-{uuid.uuid4().hex[:6]}'
    programs.mkdir()
    umount = programs / 'umount'
    umount.write_text(f'#!/bin/sh\n[ -e /run/lo.volume-{name} ] && exec /usr/bin/umount "$@"\n')
    umount.chmod(0o755)
    result = process.run(Command(('unshare', '-m', 'sh', '-ec', """
sh -ec "$1" sh "$2" "$3" root lo "$4"
mountpoint -q "$3"
PATH=$5:$PATH sh -ec "$6" sh "$2" "$3" lo yes
mountpoint -q "$3" || echo unmounted
""", 'sh', volumes._MOUNT, name, str(path), str(tmp_path / 'models'), str(programs),
        volumes._UNMOUNT), sudo=True), timeout=60.0, check=False)
    assert (result.returncode, result.stdout) == (0, 'unmounted\n'), result.stderr
    wait_until(lambda: not path.exists(), timeout=10.0, what='the folder to go')
