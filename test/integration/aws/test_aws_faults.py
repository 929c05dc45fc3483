# SPDX-License-Identifier: Apache-2.0
"""What goes wrong at AWS: no room, no rights, no answer; and robots that vanish."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.colcon_workspace import colcon_workspace

pytestmark = pytest.mark.timeout(120)

TALKER = ('fogros2_examples', 'talker.aws.launch.py')


def complaint(run):
    """Return the one line of error that a failed launch has, with what it failed with."""
    assert run.ended() != 0, run.text
    assert 'Traceback' not in run.text, run.text
    assert len(run.errors) == 1, run.text
    return run.errors[0]


def test_a_launch_gets_round_what_passes(robot, box, name):
    """No room in the first zones, throttling, and an answer to what was done that gets lost."""
    box.fail('InsufficientInstanceCapacity', action='RunInstances', times=2)
    box.fail('InternalError', action='RunInstances', after=True)
    # late: boto3 goes slowly for a while after it
    box.fail('RequestLimitExceeded', action='DeleteKeyPair')
    before = {found.id for found in box.instances()}
    run = robot.launch(*TALKER, f'name:={name}', 'count:=1')
    assert run.ended() == 0, run.text
    assert run.errors == [] and 'Traceback' not in run.text, run.text
    tried = [call.error for call in box.calls() if call.action == 'RunInstances']
    assert tried == ['InsufficientInstanceCapacity'] * 2 + ['InternalError', '']
    assert len({found.id for found in box.instances()} - before) == 1


def test_what_stays_is_said_in_one_line(robot, box, name):
    """Each launch in a region of its own, which refuses it in its own way."""
    refusals = {
        'us-west-1': ('InsufficientInstanceCapacity', 'RunInstances', 't3.medium'),
        'us-east-2': ('UnauthorizedOperation', 'CreateSecurityGroup', 'ec2:CreateSecurityGroup'),
        'eu-west-2': ('RequestExpired', 'DescribeInstances', 'clock')}
    for region, (code, action, _) in refusals.items():
        box.fail(code, action=action, region=region, times=0)
    runs = {region: robot.launch(*TALKER, f'name:={name}-{region}', f'region:={region}')
            for region in refusals}
    for region, (code, _, word) in refusals.items():
        said = complaint(runs[region])
        assert word in said and (code in said or region in said), said
    box.heal()
    assert all(found.state == 'terminated' for found in box.instances())


def test_known_problems_are_reported_before_creation(robot, box, name):
    box.publish('ami-0aaaaaaaaaaaaaaaa', region='us-east-1')
    launches = {
        'xx-nowhere-1': (['region:=xx-nowhere-1'], {}),
        'arm64': (['ec2_instance_type:=t4g.medium', 'ami_image:=ami-0aaaaaaaaaaaaaaaa'], {}),
        'credentials': ([], {'AWS_ACCESS_KEY_ID': ''}),
        'does not answer': ([], {'AWS_ENDPOINT_URL': 'http://198.51.100.1:9'})}
    runs = {word: robot.launch(*TALKER, f'name:={name}-{number}', *arguments, **variables)
            for number, (word, (arguments, variables)) in enumerate(launches.items())}
    for word, run in runs.items():
        assert word in complaint(run)
    assert not [call for call in box.calls() if call.action in (
        'RunInstances', 'CreateSecurityGroup', 'ImportKeyPair')]


LAUNCH = '''\
from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = AWSCloudInstance(name={name!r}, robot_timeout=6, **{options!r})
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words),
    ])
'''

#: The same, with little patience for the boot.
BOOTING = '''\
import sys
from fogros2.deploy import Launch
from fogros2.model import MachineSpec
from fogros2.waiting import Timeouts
Launch(timeouts=Timeouts(boot=2.0, ssh=2.0)).up(MachineSpec(sys.argv[1], 'aws'))
'''

UBUNTU = 'ID=ubuntu\nVERSION_ID="24.04"\nVERSION_CODENAME=noble\nUBUNTU_CODENAME=noble\n'
SLEEPS = '#!/bin/sh\necho "$0 $*" >>/tmp/slow.$(id -u)\nexec sleep 600\n'


@pytest.mark.timeout(240)
def test_a_machine_ends_whose_robot_was_killed(robot, box, name, tmp_path):
    """In the boot, while ROS is installed, while the workspace is on its way, and at work."""
    installing, syncing = 'ami-0bbbbbbbbbbbbbbbb', 'ami-0cccccccccccccccc'
    box.publish(installing, region='us-east-1', files={
        '/etc/os-release': UBUNTU, '/usr/local/bin/apt-get': SLEEPS})
    box.publish(syncing, region='us-east-1', files={'/usr/local/bin/rsync': SLEEPS})
    package = f'fogt_{uuid.uuid4().hex[:6]}'
    variables = colcon_workspace(tmp_path / 'workspace', package, programs={'nothing': 'pass'})
    box.set_boot_delay(1.0)
    phases = {
        'install': {'ami_image': installing, 'bootstrap': 'apt'},
        'sync': {'ami_image': syncing, 'ros_workspace': str(tmp_path / 'workspace')},
        'run': {}}
    runs = {phase: robot.launch(
        robot.write(f'{phase}.launch.py', LAUNCH.format(name=f'{name}-{phase}', options=options)),
        **(variables if phase == 'sync' else {})) for phase, options in phases.items()}
    booting = subprocess.Popen(
        box.on_robot([sys.executable, '-c', BOOTING, f'{name}-boot']),
        env=robot.environment(), start_new_session=True)
    try:
        def instance(phase):
            return next((found for found in box.instances()
                         if found.tags.get('fogros2-name') == f'{name}-{phase}'), None)

        wait_until(lambda: instance('boot'), timeout=60, what='a machine that boots')
    finally:
        os.killpg(booting.pid, signal.SIGKILL)
        booting.wait(10)

    def slow(phase, word):
        assert runs[phase].child.poll() is None, runs[phase].text
        return word in box.run(instance(phase).id, 'cat /tmp/slow.*', check=False)

    runs['run'].wait_for('I heard: ')
    for phase, word in (('install', 'apt-get'), ('sync', 'rsync')):
        wait_until(lambda p=phase, w=word: slow(p, w), timeout=60, what=f'the {phase} to begin')
    for run in runs.values():
        run.kill()
    wait_until(lambda: not box.alive(), timeout=60, what='the machines to end by themselves')
    for phase in (*phases, 'boot'):
        assert instance(phase).reason == 'Client.InstanceInitiatedShutdown'
    # what a machine can't take along goes when the robot forgets it; of the one that was killed
    # before it knew its machine, gc finds group and key by their tags, a quarter of an hour later
    deleted = robot.ros2('fog', 'delete', '--yes', 'all')
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert {kind: len(names) for kind, names in robot.things().items()} in (
        {}, {'groups': 1, 'keys': 1})
    robot.clear()
