# SPDX-License-Identifier: Apache-2.0
"""Launches on EC2 instances, from nothing to messages to nothing."""

from __future__ import annotations

import json
import os

import pytest

from fogros2.waiting import wait_until

pytestmark = pytest.mark.timeout(120)

#: What AWS may be asked for one launch at the most, from its beginning to its end.
CALLS = 25


def clean(run):
    """Return whether it said nothing that would worry anybody; Ctrl-C is a warning to launch."""
    others = run.text.replace('[WARNING] [launch]: user interrupted with ctrl-c', '')
    return run.errors == [] and 'WARNING' not in others and 'Traceback' not in others


def test_the_talker_from_nothing_to_nothing(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}')
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    assert (instance.type, instance.region, instance.state) == ('t3.medium', 'us-east-1',
                                                                'running')
    assert instance.tags['fogros2-name'] == name
    # SSH goes through the VPN by now, and its port is closed to everybody
    (group,) = [group for group in robot.api().describe_security_groups()['SecurityGroups']
                if group['GroupName'] != 'default']
    assert [rule['IpProtocol'] for rule in group['IpPermissions']] == ['udp']
    described = robot.api().describe_instances(InstanceIds=[instance.id])['Reservations'][0][
        'Instances'][0]
    assert described['MetadataOptions']['HttpTokens'] == 'required'
    (disk,) = robot.api().describe_volumes()['Volumes']
    assert (disk['VolumeType'], disk['Encrypted'], disk['Size']) == ('gp3', True, 30)
    for thing in (described, group, disk, *robot.api().describe_key_pairs()['KeyPairs']):
        assert {tag['Key']: tag['Value'] for tag in thing['Tags']}['fogros2-name'] == name
    # the host key that went through user data is nobody's any more
    data = robot.api().describe_instance_attribute(
        InstanceId=instance.id, Attribute='userData')['UserData']['Value']
    now = box.run(instance.id, 'cat /etc/ssh/ssh_host_ed25519_key.pub').split()[1]
    assert now in instance.tags['fogros2-host-key']
    assert data
    # the robot goes on from another address, as from a train, and stays there: TCP may wait for
    # seconds after one move, and longer than a machine may be silent after two in a row
    heard = run.text.count('I heard: ')
    box.move_robot()
    try:
        run.wait_for('I heard: ', times=heard + 2)
        run.interrupt()
        assert run.ended() == 0, run.text
    finally:
        box.move_robot(back=True)
    assert clean(run), run.text
    asked = [call for call in box.calls() if call.region == 'us-east-1']
    assert f'{name}: ' in run.text and 'h at $0.0416 an hour, $' in run.text
    # what this test has asked itself comes on top
    assert len(asked) - 5 <= CALLS, asked


@pytest.mark.soak  # the choice by FogROS2's own launch file is the same
def test_the_nearest_region_and_the_cheapest_type(robot, box, name):
    shown = robot.ros2('launch', 'fogros2_examples', 'talker.auto_aws.launch.py', '-s')
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert box.calls() == []
    run = robot.launch('fogros2_examples', 'talker.auto_aws.launch.py', f'name:={name}',
                       'count:=1')
    assert run.ended() == 0, run.text
    assert clean(run), run.text
    (instance,) = [found for found in box.instances()
                   if found.tags.get('fogros2-name') == name]
    # what answers, and the cheapest there with 2 vCPUs and 4 GiB of this computer's kind
    assert instance.region in ('us-east-1', 'eu-central-1', 'us-west-1')
    assert instance.type in ('t3a.medium', 't4g.medium')


TWO = '''\
from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    one = AWSCloudInstance(name='{name}-one', region='us-east-1')
    two = AWSCloudInstance(name='{name}-two', region='eu-central-1', ec2_instance_type='c5.large')
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        CloudNode(machine=one, executable='talker', **words),
        CloudNode(machine=two, executable='listener', **words),
        Node(executable='listener', name='here', **words),
    ])
'''


def test_two_regions_hear_each_other(robot, box, name):
    run = robot.launch(robot.write('two.launch.py', TWO.format(name=name)))
    run.wait_for(f'[listener]: I heard: [Hello World from {name}-one ')
    run.wait_for(f'[here]: I heard: [Hello World from {name}-one ')
    assert {found.region for found in box.alive()} == {'us-east-1', 'eu-central-1'}
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text


def test_a_stopped_instance_is_started_again(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}',
                       'on_exit:=stop', 'count:=1')
    assert run.ended() == 0, run.text
    (stopped,) = box.alive()
    box.wait_for(stopped.id, 'stopped')
    # to be deleted this time, which it was not made for
    again = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}',
                         'on_exit:=delete', 'count:=1')
    assert again.ended() == 0, again.text
    assert clean(again), again.text
    assert box.instances()[-1].id == stopped.id
    assert box.instances()[-1].tags['fogros2-on-exit'] == 'delete'
    assert box.wait_for(stopped.id, 'terminated').reason == 'Client.UserInitiatedShutdown'


@pytest.mark.soak  # the robot looks for its own address every ten seconds alone
def test_a_robot_that_moves_during_the_boot_is_let_in(robot, box, name):
    box.set_boot_delay(5.0)
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}', 'count:=1')
    wait_until(box.alive, timeout=30, what='an instance')
    box.move_robot()
    try:
        assert run.ended(90) == 0, run.text
        assert clean(run), run.text
    finally:
        box.move_robot(back=True)


def test_an_image_is_baked_found_and_deleted(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}',
                       'on_exit:=keep', 'count:=1')
    assert run.ended() == 0, run.text
    (kept,) = box.alive()

    dry = robot.ros2('fog', 'image', name, '--dry-run')
    assert dry.returncode == 0, dry.stdout + dry.stderr
    assert robot.api().describe_images(Owners=['self'])['Images'] == []
    made = robot.ros2('fog', 'image', name)
    assert made.returncode == 0, made.stdout + made.stderr
    (image,) = robot.api().describe_images(Owners=['self'])['Images']
    assert image['State'] == 'available'
    # a computer that knows nothing of this robot's machines finds this one, and ends it
    elsewhere = {'FOGROS2_STATE_HOME': str(robot.home / 'elsewhere')}
    listed = robot.ros2('fog', 'list', **elsewhere)
    assert listed.returncode == 0 and name in listed.stdout, listed.stdout + listed.stderr
    here = {'FOGROS2_AWS_REGIONS': 'us-east-1'}  # looking in all is slower
    gone = robot.ros2('fog', 'delete', '--yes', name, **elsewhere, **here)
    assert gone.returncode == 0, gone.stdout + gone.stderr
    assert box.wait_for(kept.id, 'terminated').id == kept.id
    # the robot that made it finds nothing to delete but its own memory
    forgotten = robot.ros2('fog', 'delete', '--yes', name, **here)
    assert forgotten.returncode == 0, forgotten.stdout + forgotten.stderr
    again = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}-b', 'count:=1')
    assert again.ended() == 0, again.text
    assert clean(again), again.text
    assert box.instances()[-1].image == image['ImageId']
    listed = robot.ros2('fog', 'image', 'list', '--json', **here)
    assert listed.returncode == 0, listed.stdout + listed.stderr
    (shown,) = json.loads(listed.stdout)
    deleted = robot.ros2('fog', 'image', 'delete', shown['id'], '--yes', **here)
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert robot.things() == {}


SPOT = '''\
from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription, MachineInterrupted
from launch import EventHandler
from launch.actions import LogInfo, RegisterEventHandler
from launch_ros.actions import Node


def generate_launch_description():
    machine = AWSCloudInstance(name='{name}', spot=True, on_interrupt='{how}')
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own')])),
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words),
    ])
'''


def test_spot_instances_are_taken_away(robot, box, name):
    """After a notice the nodes move to the robot; without one, the launch ends."""
    moves, ends = (robot.launch(robot.write(
        f'{how}.launch.py', SPOT.format(name=f'{name}-{how}', how=how)),
        # the two talk on the same topic, and each is to hear its own talker alone
        ROS_DOMAIN_ID=domain) for how, domain in (('robot', '101'), ('shutdown', '102')))
    for run, how in ((moves, 'robot'), (ends, 'shutdown')):
        run.wait_for(f'I heard: [Hello World from {name}-{how} ')
    instances = {found.tags['fogros2-name']: found for found in box.alive()}
    assert all(found.spot for found in instances.values())
    box.interrupt(instances[f'{name}-robot'].id, notice=60.0)
    box.interrupt(instances[f'{name}-shutdown'].id, notice=0.0)
    assert ends.ended() != 0, ends.text
    assert f'{name}-shutdown' in '\n'.join(ends.errors), ends.text
    moves.wait_for('on our own')
    moves.wait_for(f'I heard: [Hello World from {os.uname().nodename} ')
    moves.interrupt()
    assert moves.ended() == 0, moves.text
