# SPDX-License-Identifier: Apache-2.0
"""An application in a pod whose image has nothing of it: what it computes with is brought."""

from __future__ import annotations

import re
import shutil

import pytest

from rigs.launched import launching

pytest.importorskip('ompl', reason='ompl is in the extra applications')
pytest.importorskip('fcl', reason='python-fcl is in the extra applications')
pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH')]


def test_motion_planning(kubernetes, namespace, tmp_path, monkeypatch):
    if reason := kubernetes.why_not_ready:
        pytest.skip(reason)
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    drawn = tmp_path / 'planning.png'
    with launching() as start:
        run = start('fogros2_examples', 'planning.launch.py', 'machine:=kubernetes',
                    'environment:=cubicles', f'picture:={drawn}')
        # 0 says that the service's answer had a path in it
        assert run.ended(150.0) == 0, run.text
    assert run.errors == [] and 'WARNING' not in run.text, run.text
    assert re.search(r'planner: Python modules .*fcl, ompl sent', run.text), run.text
    assert re.search(r'\[planner[.]motion_planner-\d+\] .*path of \d', run.text), run.text
    assert re.search(r'\[planning_client-\d+\] .*path of \d', run.text), run.text
    assert drawn.read_bytes().startswith(b'\x89PNG')
    assert namespace.left() == []
