# SPDX-License-Identifier: Apache-2.0
"""
Take the pictures of the pages: the README's launch in a terminal, and the dashboard beside one.

    python -m rigs.pictures [terminal|dashboard] [--folder FOLDER]

Writes terminal.svg and dashboard.png into ``doc/``, or into the folder. The dashboard needs a
Chromium.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import contextlib
import ctypes
import html
import os
from pathlib import Path
import re
import socket
import sys
import tempfile

from rigs.browser import Browser, program
from rigs.dashboard import Dashboard
from rigs.launched import launching
from rigs.terminal import screen

ROOT = Path(__file__).resolve().parents[2]
#: Columns of the terminal, and messages that are heard before Ctrl-C.
COLUMNS, HEARD = 120, 3
#: Messages that are heard before the dashboard's picture, which has a curve of the traffic.
WATCHED = 30
#: Of Linux' sched.h.
CLONE_NEWUTS = 0x04000000
#: Width and height of a character in the picture, in pixels.
WIDE, HIGH = 12.2, 24.4
STREAMS = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name='planner')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='image_processor',
                  stream_topics=[('/camera', 'h264'),
                                 StreamTopic('/annotated', 'h264', 'to_robot')]),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker'),
        Node(package='fogros2_examples', executable='camera'),
        Node(package='fogros2_examples', executable='listener', output='screen'),
    ])
"""


def launch_file() -> str:
    """Return the launch file of the README."""
    block = re.search('```python\n(.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL)
    assert block is not None
    return block[1]


def terminal(path: Path) -> None:
    """Write what the README's launch draws on a terminal until Ctrl-C after some messages."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, 'bringup.launch.py').write_text(launch_file())
        words = ('ros2', 'launch', './bringup.launch.py')
        text = screen(*words, folder=Path(folder), columns=COLUMNS, timeout=120.0,
                      until=lambda text: text.count('I heard') >= HEARD)
    # neither this computer nor its user matter
    log = os.environ.get('ROS_LOG_DIR', f'{Path.home()}/.ros/log')
    for own, other in ((log, '/home/robot/.ros/log'), (f'-{os.uname().nodename}-', '-robot-')):
        text = text.replace(own, other)
    path.write_text(svg([f"$ {' '.join(words)}", *lines(text)]))


def lines(text: str) -> Iterator[str]:
    """Yield the lines that a terminal shows of a text; carriage returns overwrite a line."""
    for line in re.sub(r'\x1b\[[0-9;?]*[A-Za-z]', '', text).rstrip().split('\n'):
        line = line.rstrip('\r').rpartition('\r')[2]
        yield from (line[at:at + COLUMNS] for at in range(0, max(1, len(line)), COLUMNS))


def svg(rows: Sequence[str]) -> str:
    """Return a picture of a terminal with these rows, the command first."""
    width, height = COLUMNS * WIDE + 20, len(rows) * HIGH + 50
    tags = [
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" xmlns="http://www.w3.org/2000/svg">',
        '<title>A terminal: ros2 launch creates the machine planner, the talker there is heard '
        'here, Ctrl-C deletes the machine</title>',
        '<style>text {font: 20px Fira Code, DejaVu Sans Mono, monospace; fill: #c5c8c6} '
        '.command {font-weight: bold; fill: #98a84b}</style>',
        f'<rect fill="#292929" width="{width:.0f}" height="{height:.0f}" rx="8"/>']
    tags += [f'<circle cx="{22 + 22 * at}" cy="20" r="7" fill="{colour}"/>'
             for at, colour in enumerate(('#ff5f57', '#febc2e', '#28c840'))]
    for at, row in enumerate(rows):
        kind = ' class="command"' if at == 0 else ''
        # each row as wide as its characters, whatever font there is
        tags.append(f'<text x="10" y="{60 + at * HIGH:.1f}" textLength="{len(row) * WIDE:.1f}"'
                    f'{kind}>{html.escape(row)}</text>')
    return '\n'.join([*tags, '</svg>', ''])


def dashboard(path: Path) -> None:
    """Write how the dashboard looks beside a launch with two streams."""
    watched = Dashboard()
    with contextlib.ExitStack() as undo:
        undo.callback(watched.close)
        browser = undo.enter_context(contextlib.closing(Browser(width=1400, height=1100)))
        launch = undo.enter_context(launching())
        file = Path(undo.enter_context(tempfile.TemporaryDirectory()), 'streams.launch.py')
        file.write_text(STREAMS)
        browser.do('Emulation.setScrollbarsHidden', hidden=True)
        browser.open(watched.url)
        launched = launch(str(file))
        launched.wait_for('I heard', times=WATCHED)
        browser.until('[...document.querySelectorAll("figure img")].filter('
                      'image => image.complete && image.naturalWidth === 640).length === 2')
        browser.screenshot(path)


def main() -> int:
    """Take both pictures, or the one that is named."""
    parser = argparse.ArgumentParser(description='Take the pictures of the pages')
    parser.add_argument('what', nargs='?', choices=('terminal', 'dashboard'))
    parser.add_argument('--folder', type=Path, default=ROOT / 'doc')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as state:
        os.environ['FOGROS2_STATE_HOME'] = state
        # a robot of its own, as root: this computer's other machines are not in the pictures
        if ctypes.CDLL(None).unshare(CLONE_NEWUTS) == 0:
            socket.sethostname('rover')
        if arguments.what != 'dashboard':
            terminal(arguments.folder / 'terminal.svg')
        if arguments.what != 'terminal':
            if program() is None:
                print('The dashboard needs a Chromium.\n  sudo apt-get install chromium',
                      file=sys.stderr)
                return 1
            dashboard(arguments.folder / 'dashboard.png')
    return 0


if __name__ == '__main__':
    sys.exit(main())
