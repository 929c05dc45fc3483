# SPDX-License-Identifier: Apache-2.0
"""Launches on EC2 instances that choose their place, and robots that move meanwhile."""

from __future__ import annotations

import pytest

from fogros2.waiting import wait_until

CLOUDS = ('aws',)


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
