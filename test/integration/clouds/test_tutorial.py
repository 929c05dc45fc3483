# SPDX-License-Identifier: Apache-2.0
"""
The tutorial works word for word, on the embedded default and on ROS 2.

The name of the machine is another one, as tests share the computer.
"""

from __future__ import annotations

import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

import pytest

from rigs.launched import launching, ros2

PAGE = Path(__file__).resolve().parents[3] / 'doc' / 'tutorial.md'
FILE = 'first.launch.py'
#: What ROS 2's set-up script and an activated environment leave in a terminal.
SET_UP = re.compile(r'VIRTUAL_ENV|PATH|PYTHONPATH|LD_LIBRARY_PATH|(ROS|AMENT|COLCON|CMAKE)_.*')

CLOUDS = ('aws',)


class Tutorial:
    """
    The tutorial's launch files and commands.

    :param name: in place of ``first``.
    """

    def __init__(self, name: str, folder: Path) -> None:
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


@pytest.fixture
def tutorial(name: str, tmp_path: Path) -> Tutorial:
    return Tutorial(name, tmp_path)


def test_a_machine_that_costs_nothing(tutorial, engine, tun, name, tmp_path):
    environment = activated(tutorial.commands[1], tmp_path)
    with launching() as start:
        words = tutorial.words(f'ros2 launch ./{FILE}')
        run = start(*words[1:], environment=environment)
        run.wait_for(f'I heard: [Hello World from {name} ')
        for verb, expected in (('list', name), ('status .*', 'running'), ('logs .*', 'Publishing'),
                               ('connect .*', name)):
            said = ros2(*tutorial.words(f'ros2 fog {verb}'), environment=environment)
            # what a node says on stderr comes on stderr
            assert said.returncode == 0 and expected in said.stdout + said.stderr, said
        run.interrupt()
        assert run.ended() == 0, run.text
    assert name not in ros2('fog', 'list', environment=environment).stdout
    assert ros2(*tutorial.words('ros2 fog gc'), environment=environment).returncode == 0


@pytest.mark.soak
def test_the_same_on_ec2(tutorial, robot, name):
    for verb, expected in (('regions', 'us-east-1'), ('price .*', 't3')):
        said = robot.ros2(*tutorial.words(f'ros2 fog {verb}'))
        assert said.returncode == 0 and expected in said.stdout, said
    for launch in (tutorial.words('ros2 launch .* --machine .*')[1:], [tutorial.cloud_file]):
        run = robot.launch(*launch)
        run.wait_for(f'I heard: [Hello World from {name} ')
        listed = robot.ros2('fog', 'list').stdout
        assert name in listed and 'aws' in listed and '$' in listed
        run.interrupt()
        assert run.ended() == 0, run.text
