# SPDX-License-Identifier: Apache-2.0
"""What goes wrong at Google: no room, no rights, no answer; and robots that vanish."""

from __future__ import annotations

import os

import pytest

from fogros2.waiting import wait_until
from rigs.gce.resources import SERVICE_ACCOUNT

pytestmark = pytest.mark.timeout(150)

TALKER = ('fogros2_examples', 'talker.gcp.launch.py')

LAUNCH = '''\
from fogros2 import CloudNode, FogROSLaunchDescription, GCPCloudInstance, MachineInterrupted
from launch import EventHandler
from launch.actions import LogInfo, RegisterEventHandler
from launch_ros.actions import Node


def generate_launch_description():
    machine = GCPCloudInstance(name={name!r}, robot_timeout=6, **{options!r})
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own')])),
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words),
    ])
'''


def complaint(run):
    """Return the one line of error that a failed launch has, with what it failed with."""
    assert run.ended() != 0, run.text
    assert 'Traceback' not in run.text, run.text
    assert len(run.errors) == 1, run.text
    return run.errors[0]


def test_gcp_launch_gets_round_what_passes(robot, box, name):
    """No room in the first zones, throttling, and an answer to what was done that gets lost."""
    box.fail('ZONE_RESOURCE_POOL_EXHAUSTED', action='instances.insert', zone='us-central1-a')
    box.fail('backendError', action='instances.insert', after=True, zone='us-central1-b')
    box.fail('rateLimitExceeded', action='firewalls.delete', times=2)
    run = robot.launch(*TALKER, f'name:={name}', 'count:=1')
    assert run.ended() == 0, run.text
    assert run.errors == [] and 'Traceback' not in run.text, run.text
    tried = [(call.region[-1], call.error) for call in box.calls()
             if call.action == 'instances.insert']
    assert tried == [('a', ''), ('b', 'backendError'), ('b', '')]


@pytest.mark.parametrize(('code', 'action', 'words'), [
    ('QUOTA_EXCEEDED', 'instances.insert', 'Quotas'),
    ('forbidden', 'firewalls.insert', 'doc/gcp.md'),
    ('accessNotConfigured', 'instances.aggregatedList', 'gcloud services enable'),
    pytest.param('authError', '', 'gcloud auth', marks=pytest.mark.soak)])
def test_refusal_of_google_is_said_in_one_line(robot, box, name, code, action, words):
    box.fail(code, action=action, times=0)
    said = complaint(robot.launch(*TALKER, f'name:={name}'))
    assert words in said and name in said or words in said, said
    box.heal()


def test_gcp_problems_are_reported_before_creation(robot, box, name):
    launches = {
        'there are no Google credentials': ([], {'GOOGLE_APPLICATION_CREDENTIALS': '/nowhere'}),
        'does not answer': ([], {'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE':
                                 'http://198.51.100.1:9/'}),
        "can't be the region": (['region:=nowhere'], {})}
    for words, (arguments, variables) in launches.items():
        assert words in complaint(
            robot.launch(*TALKER, f'name:={name}', *arguments, **variables))
    assert not [call for call in box.calls() if 'insert' in call.action]


@pytest.mark.parametrize('account', [
    SERVICE_ACCOUNT, pytest.param('', marks=pytest.mark.soak)])
def test_gcp_machine_ends_whose_robot_was_killed(robot, box, name, account):
    run = robot.launch(robot.write('killed.launch.py', LAUNCH.format(
        name=name, options={'service_account': account} if account else {})))
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    run.kill()
    box.wait_for(instance.id, 'terminated' if account else 'stopped', timeout=60)
    # the firewall rules, and the disk of a machine that may not delete itself
    assert ('disks' in box.things()) == (not account)
    cleared = robot.ros2('fog', 'gc')
    assert cleared.returncode == 0, cleared.stdout + cleared.stderr
    assert box.things() == {}


@pytest.mark.soak
def test_nodes_of_a_preempted_machine_move_to_the_robot(robot, box, name):
    run = robot.launch(robot.write('spot.launch.py', LAUNCH.format(
        name=name, options={'spot': True, 'on_interrupt': 'robot'})))
    run.wait_for(f'I heard: [Hello World from {name} ')
    box.interrupt(box.alive()[0].id, notice=20.0)
    run.wait_for('on our own')
    run.wait_for(f'I heard: [Hello World from {os.uname().nodename} ')
    run.interrupt()
    assert run.ended() == 0, run.text
    wait_until(lambda: box.things() == {}, timeout=30, what='nothing to be left')
