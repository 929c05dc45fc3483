# SPDX-License-Identifier: Apache-2.0
"""The tutorial's part with a cloud works word for word; test_cli_live.py runs the other one."""

from __future__ import annotations

import pytest

from rigs.tutorial import Tutorial

CLOUDS = ('aws',)


@pytest.fixture
def tutorial(name, tmp_path):
    return Tutorial(name, tmp_path)


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
