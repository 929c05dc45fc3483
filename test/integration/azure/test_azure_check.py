# SPDX-License-Identifier: Apache-2.0
"""``make cloud-check PROVIDER=azure`` by a user of Azure in a box."""

from __future__ import annotations

from pathlib import Path
import re
import subprocess
import sys

import pytest

PROGRAM = Path(__file__).resolve().parents[3] / 'tools' / 'cloud_check.py'

pytestmark = pytest.mark.timeout(180)


def check(robot, *words, **variables):
    return subprocess.run(
        [*robot.box.on_robot([]), sys.executable, str(PROGRAM), 'azure', *words],
        env=robot.environment(**variables), stdin=subprocess.DEVNULL, capture_output=True,
        text=True, timeout=150)


def test_azure_check_runs_the_talker_and_deletes_everything(robot, box):
    done = check(robot, YES='1')
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r'-- cost: at most \$0\.\d+ \(\d+ s at \$0\.\d+ an hour\)', done.stdout)
    assert 'azure works: 5 messages arrived, and nothing is left.' in done.stdout
    assert box.alive() == [] and robot.groups() == []


def test_azure_check_asks_before_it_creates_anything(robot, box):
    done = check(robot, '--options', 'region=eastus')
    assert done.returncode == 1
    assert re.search(r"creates 'check-\w+': a resource group .* in eastus", done.stdout,
                     re.DOTALL)
    assert 'YES=1' in done.stdout and 'Nothing was created.' in done.stdout
    assert 'PUT' not in {call.action for call in box.calls()}
