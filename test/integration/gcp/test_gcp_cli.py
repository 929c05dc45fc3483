# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog`` and ``make cloud-check PROVIDER=gcp`` by a user of Compute Engine in a box."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

import pytest

PROGRAM = Path(__file__).resolve().parents[3] / 'tools' / 'cloud_check.py'

pytestmark = pytest.mark.timeout(180)


def test_gcp_check_runs_the_talker_and_deletes_everything(robot, box):
    done = subprocess.run(
        [*box.on_robot([]), sys.executable, str(PROGRAM), 'gcp'],
        env=robot.environment(YES='1'), stdin=subprocess.DEVNULL, capture_output=True, text=True,
        timeout=150)
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'gcp: project robots, us-central1' in done.stdout
    assert 'gcp works: 5 messages arrived, and nothing is left.' in done.stdout
    assert box.things() == {}


def test_kept_machine_is_baked_listed_and_deleted(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.gcp.launch.py', f'name:={name}',
                       'on_exit:=keep', 'count:=1')
    assert run.ended() == 0, run.text
    made = robot.ros2('fog', 'image', name)
    assert made.returncode == 0, made.stdout + made.stderr
    # a computer that knows nothing of this robot's machines finds this one, by one request
    elsewhere = {'FOGROS2_STATE_HOME': str(robot.home / 'elsewhere')}
    box.forget_calls()
    listed = robot.ros2('fog', 'list', '--json', **elsewhere)
    (found,) = [one for one in json.loads(listed.stdout) if one['name'] == name]
    assert found['provider'] == 'gcp' and found['disk_gb'] == 30
    assert [call.action for call in box.calls()] == ['instances.aggregatedList']
    doctor = robot.ros2('fog', 'doctor', '--provider', 'gcp')
    assert 'project robots' in doctor.stdout, doctor.stdout + doctor.stderr
    images = robot.ros2('fog', 'image', 'list', '--json')
    (image,) = json.loads(images.stdout)
    gone = robot.ros2('fog', 'delete', '--yes', name)
    assert gone.returncode == 0, gone.stdout + gone.stderr
    deleted = robot.ros2('fog', 'image', 'delete', image['id'], '--yes')
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert box.things() == {}


def test_stopped_machine_is_started_again(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.gcp.launch.py', f'name:={name}',
                       'on_exit:=stop', 'count:=1')
    assert run.ended() == 0, run.text
    (stopped,) = box.alive()
    box.wait_for(stopped.id, 'stopped')
    again = robot.launch('fogros2_examples', 'talker.gcp.launch.py', f'name:={name}',
                         'on_exit:=delete', 'count:=1')
    assert again.ended() == 0, again.text
    assert box.instances()[-1].id == stopped.id
    assert box.things() == {}
