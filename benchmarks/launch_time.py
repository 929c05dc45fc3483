# SPDX-License-Identifier: Apache-2.0
"""
From ``ros2 launch`` to the first message of a node on a machine, beside the same pair here.

The machine is a container of this computer that sees the computer's own files, ROS 2 too: nothing
boots and nothing is installed. So its time is not one of a cloud's machine.
"""

from __future__ import annotations

from pathlib import Path
import subprocess
import tempfile
import time

from figures import Row, write

RUNS = 10
CONTAINER = "local container with this computer's files, bind-mounted"
NAME = 'bench-launch'


#: The talker sends often: a message that none hears yet must not cost a second of its period.
LAUNCH = """\
from launch.actions import Shutdown
{imports}


def generate_launch_description():
    return LaunchDescription([
        Node(package='fogros2_examples', executable='talker', parameters=[{{'period': 0.02}}],
             {machine}),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{{'count': 1}}], on_exit=Shutdown())])
"""
PLAIN = 'from launch import LaunchDescription\nfrom launch_ros.actions import Node'
OURS = """\
from fogros2 import ContainerInstance, FogROSLaunchDescription as LaunchDescription, Node"""


def launch_file(path: Path, imports: str, machine: str = '') -> Path:
    """Write a launch file with the talker on a machine, or here."""
    path.write_text(LAUNCH.format(imports=imports, machine=machine))
    return path


def first_message(path: Path) -> float:
    """Return the seconds from the start of a launch to the first message that is heard."""
    begin = time.perf_counter()
    child = subprocess.Popen(['ros2', 'launch', path], stdout=subprocess.PIPE,
                             stderr=subprocess.STDOUT, text=True)
    assert child.stdout is not None
    heard = None
    said = []
    for line in child.stdout:
        said.append(line)
        if heard is None and 'I heard' in line:
            heard = time.perf_counter() - begin
    if child.wait() != 0 or heard is None:
        raise SystemExit(f'the launch failed:\n{"".join(said)}')
    return heard


def main() -> None:
    """Take the runs in turn, so that the computer's moods fall on all alike."""
    here, new, kept = [], [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        alone = launch_file(folder / 'alone.launch.py', PLAIN)
        created = launch_file(folder / 'new.launch.py', OURS,
                              f"machine=ContainerInstance(name='{NAME}')")
        stays = launch_file(folder / 'kept.launch.py', OURS,
                            f"machine=ContainerInstance(name='{NAME}-kept', on_exit='keep')")
        try:
            first_message(stays)
            for _ in range(RUNS):
                here.append(first_message(alone))
                new.append(first_message(created))
                kept.append(first_message(stays))
        finally:
            subprocess.run(['ros2', 'fog', 'delete', '--yes', f'{NAME}-kept'], check=False)
    write('launch_time', 'From ros2 launch to the first message', [
        Row.of('both nodes here', here, 's'),
        Row.of(f'talker on a new {CONTAINER}', new, 's'),
        Row.of(f'talker on a kept {CONTAINER}', kept, 's'),
        Row.of(f'new {CONTAINER}: more than here', [one - alone for one, alone in zip(new, here)],
               's', 1.8, published='no such machine in the paper'),
        Row.of(f'kept {CONTAINER}: more than here',
               [one - alone for one, alone in zip(kept, here)], 's', 0.9),
    ])


if __name__ == '__main__':
    main()
