# SPDX-License-Identifier: Apache-2.0
"""Who follows the tutorial word for word arrives: but for the machine's name, which is shared."""

from __future__ import annotations

import os
from pathlib import Path
import re
import shlex

import pytest

from fogros2.testing.launched import launching, ros2

PAGE = Path(__file__).resolve().parents[3] / 'doc' / 'tutorial.md'
FILE = 'first.launch.py'

pytestmark = pytest.mark.timeout(180)


class Tutorial:
    """
    The tutorial's files and commands.

    :param name: in place of ``first``.
    """

    def __init__(self, name: str, folder: Path) -> None:
        text = re.sub(r'\bfirst\b(?!\.launch)', name, PAGE.read_text())
        blocks = re.findall(r'```(\w+)\n(.*?)```', text, re.DOTALL)
        self.files = []
        for number, source in enumerate(text for kind, text in blocks if kind == 'python'):
            path = folder / f'{number}.launch.py'
            path.write_text(source)
            self.files.append(str(path))
        self.commands = [line[2:] for kind, block in blocks if kind == 'console'
                         for line in block.splitlines()]

    def words(self, pattern: str) -> list[str]:
        """Return the words after ``ros2`` of the one command that looks so."""
        (line,) = [line for line in self.commands if re.fullmatch(pattern, line)]
        return [self.files[0] if word == f'./{FILE}' else word for word in shlex.split(line)[1:]]


@pytest.fixture
def tutorial(name: str, tmp_path: Path) -> Tutorial:
    return Tutorial(name, tmp_path)


def test_a_machine_that_costs_nothing(tutorial, engine, tun, name, tmp_path):
    environment = {**os.environ, 'HOME': str(tmp_path), 'ROS_LOG_DIR': str(tmp_path / 'log')}
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
    for launch in (tutorial.words('ros2 launch .* --machine .*')[1:], [tutorial.files[1]]):
        run = robot.launch(*launch)
        run.wait_for(f'I heard: [Hello World from {name} ')
        listed = robot.ros2('fog', 'list').stdout
        assert name in listed and 'aws' in listed and '$' in listed
        run.interrupt()
        assert run.ended() == 0, run.text
