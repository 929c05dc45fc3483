# SPDX-License-Identifier: Apache-2.0
"""The picture of a terminal shows what a launch prints."""

from __future__ import annotations

import html
from pathlib import Path
import re
import subprocess
import sys

import pytest

from rigs import pictures
from rigs.launched import embedded

pytestmark = [pytest.mark.usefixtures('nothing_left', 'engine')]
DOC = pictures.ROOT / 'doc'


def shown(picture: Path) -> set[str]:
    """Return the lines of a terminal's picture without numbers, addresses and the log's folder."""
    rows = map(html.unescape, re.findall('<text[^>]*>(.*?)</text>', picture.read_text()))
    # a computer of the tests may be a container, which has no control groups (version 2)
    return {re.sub(r'fog[0-9a-f]{6}|(?<=below ).*|[0-9]+(\.[0-9]+)*', '#', row.replace('^C', ''))
            for row in rows if 'DDS filter failed' not in row}


def test_terminal_picture_shows_what_a_launch_prints(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'rigs.pictures', 'terminal', '--folder', str(tmp_path)],
        cwd=pictures.ROOT / 'test', capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = shown(tmp_path / 'terminal.svg')
    assert {'$ ros# launch ./bringup.launch.py', '[INFO] [fogros#]: planner: delete # s'} <= lines
    assert any('I heard: [Hello World from planner' in line for line in lines)
    if embedded():
        assert lines == shown(DOC / 'terminal.svg'), 'make pictures takes it anew'
