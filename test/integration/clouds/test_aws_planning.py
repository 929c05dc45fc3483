# SPDX-License-Identifier: Apache-2.0
"""An application on an EC2 instance: a path comes back from it, and nothing stays."""

from __future__ import annotations

import re

import pytest

pytest.importorskip('ompl', reason='ompl is in the extra applications')
pytest.importorskip('fcl', reason='python-fcl is in the extra applications')

CLOUDS = ('aws',)
pytestmark = pytest.mark.soak


def test_motion_planning(robot, box, tmp_path):
    drawn = tmp_path / 'planning.png'
    run = robot.launch('fogros2_examples', 'planning.launch.py', 'machine:=aws',
                       'environment:=cubicles', f'picture:={drawn}')
    # 0 says that the service's answer had a path in it
    assert run.ended() == 0, run.text
    assert run.errors == [] and 'WARNING' not in run.text, run.text
    assert re.search(r'\[planner[.]motion_planner-\d+\] .*path of \d', run.text), run.text
    assert re.search(r'\[planning_client-\d+\] .*path of \d', run.text), run.text
    assert drawn.read_bytes().startswith(b'\x89PNG')
    (instance,) = [found for found in box.instances() if found.tags['fogros2-name'] == 'planner']
    assert instance.state == 'terminated'
    assert box.alive() == [] and robot.things() == {}
