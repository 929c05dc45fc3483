# SPDX-License-Identifier: Apache-2.0
"""
From ``ros2 launch`` to the first message of a node on a machine, beside the same pair here.

The machine is a container of this computer that sees the computer's own files, ROS 2 too: nothing
boots and nothing is installed. So its time is not one of a cloud's machine.
"""

from __future__ import annotations

import subprocess
import time

from figures import Row, write

RUNS = 10
CONTAINER = "local container with this computer's files, bind-mounted"
NAME = 'bench-launch'


def first_message(*arguments: str) -> float:
    """Return the seconds from the start of a launch to the first message that is heard."""
    begin = time.perf_counter()
    child = subprocess.Popen(
        ['ros2', 'launch', 'fogros2_examples', *arguments, 'count:=1'],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
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
    container = ('talker.container.launch.py', f'name:={NAME}')
    try:
        first_message('talker.container.launch.py', f'name:={NAME}-kept', 'on_exit:=keep')
        for _ in range(RUNS):
            here.append(first_message('talker.local.launch.py'))
            new.append(first_message(*container))
            kept.append(first_message(
                'talker.container.launch.py', f'name:={NAME}-kept', 'on_exit:=keep'))
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
