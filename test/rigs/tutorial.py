# SPDX-License-Identifier: Apache-2.0
"""The launch files and commands of the tutorial, and the terminal that it has."""

from __future__ import annotations

import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

PAGE = Path(__file__).resolve().parents[2] / 'doc' / 'tutorial.md'
FILE = 'first.launch.py'
#: What ROS 2's set-up script and an activated environment leave in a terminal.
SET_UP = re.compile(r'VIRTUAL_ENV|PATH|PYTHONPATH|LD_LIBRARY_PATH|(ROS|AMENT|COLCON|CMAKE)_.*')


class Tutorial:
    """
    The tutorial's launch files and commands.

    :param name: in place of ``first``.
    """

    def __init__(self, name: str, folder: Path) -> None:
        self.name = name
        text = re.sub(r'\bfirst\b(?!\.launch)', name, PAGE.read_text())
        blocks = re.findall(r'```(\w+)\n(.*?)```', text, re.DOTALL)
        (source,) = [block for kind, block in blocks if kind == 'python']
        (machine,) = re.findall(r'`(AWSCloudInstance\(.*?\))`', text)
        (container,) = re.findall(r'machine = (.*)', source)
        self.file, self.cloud_file = str(folder / FILE), str(folder / 'cloud.launch.py')
        Path(self.file).write_text(source)
        Path(self.cloud_file).write_text(source.replace(container, machine).replace(
            'ContainerInstance', 'AWSCloudInstance'))
        self.commands = [line[2:] for kind, block in blocks if kind == 'console'
                         for line in block.splitlines()]

    def words(self, pattern: str) -> list[str]:
        """Return the words after ``ros2`` of the one command that looks so."""
        (line,) = [line for line in self.commands if re.fullmatch(pattern, line)]
        return [self.file if word == f'./{FILE}' else word for word in shlex.split(line)[1:]]


def activated(line: str, home: Path) -> dict[str, str]:
    """Return the variables of a new terminal after the line that activates the environment."""
    assert line == '. .venv/bin/activate'
    fresh = {name: value for name, value in os.environ.items()
             if not SET_UP.fullmatch(name) or name == 'ROS_DOMAIN_ID'}
    printed = subprocess.run(
        ['bash', '-c', f'. {shlex.quote(sys.prefix)}/bin/activate && env -0'],
        capture_output=True, text=True, check=True, env={
            **fresh, 'PATH': f'/usr/local/sbin:/usr/sbin:/sbin:{os.defpath}', 'HOME': str(home),
            'ROS_LOG_DIR': str(home / 'log')}).stdout
    return dict(line.partition('=')[::2] for line in printed.split('\0') if line)
