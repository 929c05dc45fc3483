# SPDX-License-Identifier: Apache-2.0
"""Launches on EC2 instances that choose their place, and robots that move meanwhile."""

from __future__ import annotations

import pytest

from fogros2.waiting import wait_until

CLOUDS = ('aws',)


@pytest.mark.soak  # the choice by FogROS2's own launch file is the same
def test_the_nearest_region_and_the_cheapest_type(robot, box, name):
    shown = robot.ros2('launch', 'fogros2_examples', 'talker.auto_aws.launch.py', '-s')
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert box.calls() == []
    run = robot.launch('fogros2_examples', 'talker.auto_aws.launch.py', f'name:={name}',
                       'count:=1')
    assert run.ended() == 0, run.text
    assert run.clean, run.text
    (instance,) = [found for found in box.instances()
                   if found.tags.get('fogros2-name') == name]
    # what answers, and the cheapest there with 2 vCPUs and 4 GiB of this computer's kind
    assert instance.region in ('us-east-1', 'eu-central-1', 'us-west-1')
    assert instance.type in ('t3a.medium', 't4g.medium')


@pytest.mark.soak  # the robot looks for its own address every ten seconds alone
def test_a_robot_that_moves_during_the_boot_is_let_in(robot, box, name):
    box.set_boot_delay(5.0)
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}', 'count:=1')
    wait_until(box.alive, timeout=60, what='an instance')
    box.move_robot()
    try:
        assert run.ended() == 0, run.text
        assert run.clean, run.text
    finally:
        box.move_robot(back=True)
