# SPDX-License-Identifier: Apache-2.0
"""Launches on Compute Engine instances, from nothing to messages to nothing."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.timeout(120)

#: What Google may be asked for one launch at the most, from its beginning to its end.
CALLS = 25


def clean(run):
    """Return whether it said nothing that would worry anybody; Ctrl-C is a warning to launch."""
    others = run.text.replace('[WARNING] [launch]: user interrupted with ctrl-c', '')
    return run.errors == [] and 'WARNING' not in others and 'Traceback' not in others


def test_gcp_talker_from_nothing_to_nothing(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.gcp.launch.py', f'name:={name}')
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    assert (instance.type, instance.region) == ('e2-medium', 'us-central1')
    assert instance.tags['fogros2-name'] == name
    # SSH goes through the VPN by now: its rule is gone, everybody else is denied
    (host,) = box.things()['instances']
    assert sorted(box.things()['firewalls']) == [f'{host}-deny', f'{host}-vpn']
    deny = box.firewall(f'{host}-deny')
    assert (deny['denied'], deny['sourceRanges'], deny['targetTags']) == (
        [{'IPProtocol': 'all'}], ['0.0.0.0/0'], [host])
    assert 1000 < deny['priority'] < 65534
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text
    calls = box.calls()
    assert len(calls) <= CALLS, [call.action for call in calls]


TWO = '''\
from fogros2 import CloudNode, FogROSLaunchDescription, GCPCloudInstance
from launch_ros.actions import Node


def generate_launch_description():
    one = GCPCloudInstance(name='{name}-one', region='nearest')
    two = GCPCloudInstance(name='{name}-two', zone='europe-west3-b', machine_type='n2-standard-2')
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        CloudNode(machine=one, executable='talker', **words),
        CloudNode(machine=two, executable='listener', **words),
        Node(executable='listener', name='here', **words),
    ])
'''


@pytest.mark.soak
def test_machines_of_two_zones_hear_each_other(robot, box, name):
    path = robot.write('two.launch.py', TWO.format(name=name))
    shown = robot.ros2('launch', path, '-s')
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert box.calls() == []
    run = robot.launch(path)
    run.wait_for(f'[listener]: I heard: [Hello World from {name}-one ')
    run.wait_for(f'[here]: I heard: [Hello World from {name}-one ')
    found = {i.tags['fogros2-name']: i for i in box.alive()}
    assert found[f'{name}-one'].region in ('us-central1', 'europe-west3')
    assert found[f'{name}-two'].zone == 'europe-west3-b'
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text
