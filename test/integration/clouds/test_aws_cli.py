# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog`` on the robot, with instances beside it: what it shows, and how a robot gets in."""

from __future__ import annotations

import json
import time

import pytest

from fogros2.waiting import wait_until

boto3 = pytest.importorskip('boto3', reason='needs boto3')
CLOUDS = ('aws',)
pytestmark = pytest.mark.soak


#: Asking all regions is another test's.
HERE = {'FOGROS2_AWS_REGIONS': 'us-east-1 eu-central-1'}


def fog(robot, *words, **variables):
    done = robot.ros2('fog', *words, **{**HERE, **variables})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def changed_ports(box):
    """Return what the requests since the last look have opened and closed."""
    asked = [call.action for call in box.calls() if call.action.endswith('GroupIngress')]
    box.forget_calls()
    return asked


def test_beside_a_launch_the_way_in_is_the_vpn(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}')
    run.wait_for(f'I heard: [Hello World from {name} ')
    # what follows goes by the closed port's other way in
    run.wait_for('port 22 closed')
    changed_ports(box)
    (entry,) = [e for e in json.loads(fog(robot, 'list', '--json'))['machines']
                if e['name'] == name]
    assert (entry['place'], entry['kind'], entry['state']) == ('us-east-1', 't3.medium', 'running')
    assert entry['cost_per_hour'] == 0.0416 and entry['launch_alive']
    assert entry['image'].startswith('ami-') and entry['key'].startswith('fogros2-')
    assert entry['disk_gb'] == 30
    assert 0 < entry['cost'] < 0.01
    shown = fog(robot, 'list')
    assert '$0.0416 an hour, $0.00 so far' in shown and 'us-east-1' in shown
    assert fog(robot, 'connect', name, '--', 'hostname').strip() == name
    logs = robot.ros2('fog', 'logs', name)
    assert logs.returncode == 0 and 'Publishing' in logs.stderr, logs.stdout + logs.stderr
    status = json.loads(fog(robot, 'status', name, '--json'))
    assert status['problems'] == [] and status['agent']['nodes'][0]['state'] == 'running'
    assert changed_ports(box) == []
    refused = robot.ros2('fog', 'delete', name, '--yes', **HERE)
    assert refused.returncode != 0 and 'has the machine' in refused.stdout + refused.stderr
    run.interrupt()
    assert run.ended() == 0, run.text


def test_a_kept_machine_is_entered_through_its_firewall(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}',
                       'on_exit:=keep', 'count:=1')
    assert run.ended() == 0, run.text
    changed_ports(box)
    here = fog(robot, 'connect', name, '--', 'sh', '-c', 'echo $SSH_CONNECTION').split()[0]
    assert changed_ports(box)[-1] == 'RevokeSecurityGroupIngress'
    # the robot's address changes: it lets itself in from where it is now
    there = box.move_robot()
    try:
        assert there != here
        assert fog(robot, 'connect', name, '--', 'sh', '-c',
                   'echo $SSH_CONNECTION').split()[0] == there
    finally:
        box.move_robot(back=True)
    group, = groups(box)
    assert [rule['IpProtocol'] for rule in group['IpPermissions']] == ['udp']
    # past its lifetime, which its tags alone tell where nobody remembers it
    (kept,) = box.alive()
    assert float(kept.tags['fogros2-expires']) > time.time() + 3600
    robot.api().create_tags(
        Resources=[kept.id],
        Tags=[{'Key': 'fogros2-expires', 'Value': str(int(time.time()) - 120)}])
    cleared = fog(robot, 'gc', FOGROS2_STATE_HOME=str(robot.home / 'elsewhere'))
    assert f'cleared machine {name}: past its lifetime' in cleared
    assert box.wait_for(kept.id, 'terminated').id == kept.id
    assert groups(box) == []
    # the robot that made it has nothing to delete but its memory
    deleted = fog(robot, 'delete', name, '--yes')
    assert 'gone' in deleted and f'deleted {name}' in deleted


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


def groups(box):
    ec2 = boto3.client('ec2', region_name='us-east-1', **box.client_arguments)
    return [group for group in ec2.describe_security_groups()['SecurityGroups']
            if group['GroupName'] != 'default']
