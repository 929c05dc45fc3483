# SPDX-License-Identifier: Apache-2.0
"""What the command line and the imports cost."""

from __future__ import annotations

import os
import subprocess
import sys

from figures import Row, seconds, write

from fogros2.deploy import Launch
from fogros2.model import MachineSpec

RUNS = 15


def command(*words: str) -> float:
    """Return the seconds that a command takes."""
    return seconds(lambda: subprocess.run(words, check=True, stdout=subprocess.DEVNULL))


def imports(statement: str, before: str = '') -> float:
    """Return the seconds that a statement takes in a fresh interpreter, after another."""
    code = (f'{before}\nimport time\nbegin = time.perf_counter()\n{statement}\n'
            'print(time.perf_counter() - begin)')
    return float(subprocess.run(
        [sys.executable, '-c', code], check=True, capture_output=True, text=True).stdout)


def main() -> None:
    """Take the commands in turn, with a container machine up that ``list`` shows."""
    # With it each import would compile its modules anew, which no user's does.
    os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
    listed, bare, package, node = [], [], [], []
    launch = Launch()
    try:
        launch.up(MachineSpec('bench-list', 'container'))
        for _ in range(RUNS):
            bare.append(command('ros2', '-h'))
            listed.append(command('ros2', 'fog', 'list'))
            package.append(imports('import fogros2'))
            node.append(imports('from fogros2 import CloudNode', 'import launch_ros.actions'))
    finally:
        launch.down()
    sdk = subprocess.run(
        [sys.executable, '-c',
         'import fogros2, sys; print([m for m in ("paramiko", "boto3", "kubernetes", "rclpy")'
         ' if m in sys.modules])'], check=True, capture_output=True, text=True).stdout.strip()
    if sdk != '[]':
        raise SystemExit(f'import fogros2 imports {sdk}')
    write('command_line', 'Command line and imports', [
        Row.of('ros2 -h', bare, 's'),
        Row.of('ros2 fog list', listed, 's',
               published='not published; its code: 0.46 s for one empty local region'),
        Row.of('ros2 fog list, more than ros2 -h',
               [one - other for one, other in zip(listed, bare)], 's', 0.15),
        Row.of('import fogros2', package, 's', 0.03,
               published='not published; its code: 0.36 s'),
        Row.of('from fogros2 import CloudNode, after launch_ros', node, 's', 0.05),
    ])


if __name__ == '__main__':
    main()
