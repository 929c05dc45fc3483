# SPDX-License-Identifier: Apache-2.0
"""What becomes of machines at Azure: strangers, evictions, killed robots, stops, images."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import subprocess
import sys

import pytest

from fogros2.errors import MachineNotFound
from fogros2.model import MachineSpec, MachineState
from fogros2.provider import TAG_ON_EXIT
from fogros2.provider.azure import AzureProvider, cloud
from fogros2.provider.azure.account import Account
from fogros2.testing import request_for
from fogros2.waiting import wait_until
from rigs.azure import service
from rigs.computers.network import ROBOT

pytestmark = pytest.mark.timeout(120)

#: Looks at all ports below 1024, and some above, of the address that it is given.
SCAN = """
import concurrent.futures, socket, sys
def open_port(port, timeout=0.4):
    with socket.socket() as probe:
        probe.settimeout(timeout)
        return port if probe.connect_ex((sys.argv[1], port)) == 0 else None
ports = [*range(1, 1024), 3389, 5353, 7400, 7411, 8080, 8765, 8766, 51820]
open_port(9, 1.5)  # the first packet has to find the way
with concurrent.futures.ThreadPoolExecutor(256) as pool:
    print(sorted(filter(None, pool.map(open_port, ports))))
"""
LAUNCH = """\
from fogros2 import AzureCloudInstance, CloudNode, FogROSLaunchDescription, MachineInterrupted
from launch import EventHandler
from launch.actions import LogInfo, RegisterEventHandler
from launch_ros.actions import Node


def generate_launch_description():
    machine = AzureCloudInstance(name={name!r}, robot_timeout=6, **{options!r})
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own')])),
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words),
    ])
"""


@pytest.fixture
def provider(box, robot, monkeypatch):
    """Return the provider, in this process; the robot's address is that of the robot."""
    for name, value in service.environment(box.endpoint).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('FOGROS2_ROBOT_ADDRESS', ROBOT)
    monkeypatch.setattr(cloud, '_USUAL', Account())
    return AzureProvider()


def make(provider, name, on_exit='delete', **options):
    spec = MachineSpec(name, 'azure', options, on_exit=on_exit)
    machine = provider.create(spec, request_for(spec, **{TAG_ON_EXIT: on_exit}))
    return provider.reachable(machine, name=name, timeout=30.0)


def booted(box):
    wait_until(lambda: all(one.ready > 0 for one in box.alive()), timeout=20, what='SSH servers')


def scan(box, address):
    return subprocess.run(
        box.on_robot([sys.executable, '-ISc', SCAN, address]), check=True, capture_output=True,
        text=True, timeout=60).stdout.strip()


def ending(box, machine):
    """Return the machine's end command, which names the box as the machine reaches it."""
    return shlex.join((*machine.end_command[:-1], box.inside))


def test_stranger_finds_no_open_port(provider, box, name):
    machine = make(provider, name)
    (instance,) = box.alive()
    booted(box)
    assert scan(box, instance.public) == '[22]'  # the robot's own view
    box.move_robot()  # to an address that is not admitted: a stranger
    try:
        assert scan(box, instance.public) == '[]'
    finally:
        box.move_robot(back=True)
    provider.allow(machine.id, 22, [])
    assert scan(box, instance.public) == '[]'
    provider.destroy(machine.id)


def test_killed_robot_s_machine_deletes_its_group(robot, box, name):
    run = robot.launch(robot.write('run.launch.py', LAUNCH.format(name=name, options={})))
    run.wait_for('I heard: ')
    run.kill()
    wait_until(lambda: not robot.groups(), timeout=60, what='the group to be deleted')
    assert not box.alive()
    # nobody else was asked to
    assert [call.action for call in box.calls()].count('DELETE') == 2  # the SSH rule, the group
    forgotten = robot.ros2('fog', 'delete', '--yes', 'all')
    assert forgotten.returncode == 0, forgotten.stdout + forgotten.stderr


@pytest.mark.soak
def test_credentials_stay_with_the_robot(robot, box, name):
    run = robot.launch(robot.write('run.launch.py', LAUNCH.format(name=name, options={})),
                       FOGROS2_STATE_HOME=str(robot.home / 'state'))
    run.wait_for('I heard: ')
    (machine,) = box.alive()
    words = ['grep', '-rlF', '-e', service.TOKEN, '-e', service.HEADER]
    there = box.run(machine.id, f'{shlex.join(words)} /etc /home /root /opt /run /tmp /var || :')
    here = subprocess.run([*words, str(robot.home)], capture_output=True, text=True).stdout
    arguments = subprocess.run(['ps', '-eo', 'args'], capture_output=True, text=True).stdout
    shown = json.dumps(box.things()) + run.text + arguments.replace(shlex.join(words), '')
    assert (there.strip(), here) == ('', '')
    assert service.TOKEN not in shown and service.HEADER not in shown
    assert 'OPENSSH PRIVATE KEY' not in shown
    run.interrupt()
    assert run.ended() == 0, run.text


@pytest.mark.soak
def test_machine_without_the_right_is_off_and_billed(robot, box, name):
    box.set_rights(owner=False)
    run = robot.launch(robot.write('run.launch.py', LAUNCH.format(name=name, options={})))
    run.wait_for('I heard: ')
    # the lifetime is eight hours
    assert 'powers itself off and is billed' in run.text and 'at most $0.30' in run.text
    (machine,) = box.alive()
    run.kill()
    box.wait_for(machine.id, 'stopped', timeout=60)
    assert any('/schedules/' in path for path in box.things()['resources'])
    deleted = robot.ros2('fog', 'delete', '--yes', 'all')
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert robot.groups() == []


def test_machine_waits_until_its_role_works(provider, box, name):
    box.set_rights(owner=True, propagation=600.0)
    machine = make(provider, name)
    (instance,) = box.alive()
    booted(box)
    # a machine's uptime is that of this computer here
    young = dataclasses.replace(machine, end_command=tuple(
        word.replace('/proc/uptime', '/tmp/uptime') for word in machine.end_command))
    box.run(instance.id, 'echo 60.0 60.0 >/tmp/uptime')
    assert 'status=1' in box.run(instance.id, f'{ending(box, young)} || echo status=$?')
    box.set_rights(owner=True)
    assert 'status' not in box.run(instance.id, f'{ending(box, young)} || echo status=$?',
                                   check=False)
    wait_until(lambda: not box.things()['groups'], timeout=20, what='its group to be deleted')


@pytest.mark.soak
def test_machine_that_stops_at_its_end_deallocates_itself(provider, box, name):
    machine = make(provider, name, on_exit='stop')
    (instance,) = box.alive()
    booted(box)
    box.run(instance.id, 'echo kept >/root/kept')
    box.run(instance.id, ending(box, machine), check=False)
    box.wait_for(instance.id, 'deallocated')
    assert provider.describe(machine.id).state is MachineState.STOPPED
    provider.start(machine.id)
    box.wait_for(instance.id, 'running', computer=True)
    assert provider.reachable(machine.id, name=name, timeout=20).shell == machine.shell
    assert box.run(instance.id, 'cat /root/kept').strip() == 'kept'
    provider.destroy(machine.id)
    with pytest.raises(MachineNotFound):
        provider.describe(machine.id)


@pytest.mark.soak
def test_machine_may_do_nothing_else(provider, box, name):
    one, two = make(provider, f'{name}-a'), make(provider, f'{name}-b')
    booted(box)
    instance = next(i for i in box.alive() if i.tags['fogros2-name'] == f'{name}-a')
    # its command, with the other machine's group
    changed = dataclasses.replace(one, end_command=tuple(word.replace(
        "me['resourceId'].split('/providers/')[0]",
        f"me['resourceId'].split('/resourceGroups/')[0] + '/resourceGroups/"
        f"{two.id.split('/')[1]}'").replace('subprocess.run', 'print')
        for word in one.end_command))
    box.run(instance.id, ending(box, changed), check=False)
    assert box.calls()[-1].error == 'AuthorizationFailed'
    assert len(box.things()['groups']) == 2
    for machine in (one, two):
        provider.destroy(machine.id)


@pytest.mark.soak
def test_evicted_machines_nodes_move_or_the_launch_ends(robot, box, name):
    """After a notice the nodes move to the robot; without one, the launch ends."""
    moves, ends = (robot.launch(robot.write(f'{how}.launch.py', LAUNCH.format(
        name=f'{name}-{how}', options={'spot': True, 'on_interrupt': how})),
        # the two talk on the same topic, and each is to hear its own talker alone
        ROS_DOMAIN_ID=domain) for how, domain in (('robot', '101'), ('shutdown', '102')))
    for run, how in ((moves, 'robot'), (ends, 'shutdown')):
        run.wait_for(f'I heard: [Hello World from {name}-{how} ')
    instances = {found.tags['fogros2-name']: found for found in box.alive()}
    assert all(found.spot for found in instances.values())
    box.interrupt(instances[f'{name}-robot'].id, notice=30.0)
    box.interrupt(instances[f'{name}-shutdown'].id, notice=0.0)
    assert ends.ended() != 0, ends.text
    assert f'{name}-shutdown' in '\n'.join(ends.errors), ends.text
    moves.wait_for('on our own')
    moves.wait_for(f'I heard: [Hello World from {os.uname().nodename} ')
    moves.interrupt()
    assert moves.ended() == 0, moves.text


@pytest.mark.soak
def test_image_is_baked_found_and_deleted(robot, box, name):
    talker = ('fogros2_examples', 'talker.azure.launch.py', 'count:=1')
    run = robot.launch(*talker, f'name:={name}', 'on_exit:=keep')
    assert run.ended() == 0, run.text
    made = robot.ros2('fog', 'image', name)
    assert made.returncode == 0, made.stdout + made.stderr
    # a computer that knows nothing of this robot's machines finds this one, and ends it
    elsewhere = {'FOGROS2_STATE_HOME': str(robot.home / 'elsewhere')}
    listed = robot.ros2('fog', 'list', **elsewhere)
    assert listed.returncode == 0 and name in listed.stdout, listed.stdout + listed.stderr
    gone = robot.ros2('fog', 'delete', '--yes', name, **elsewhere)
    assert gone.returncode == 0, gone.stdout + gone.stderr
    again = robot.launch(*talker, f'name:={name}-b')
    assert again.ended() == 0, again.text
    assert '/galleries/' in box.instances()[-1].image
    listed = robot.ros2('fog', 'image', 'list', '--json')
    (shown,) = json.loads(listed.stdout)
    deleted = robot.ros2('fog', 'image', 'delete', shown['id'], '--yes')
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert robot.groups() == []
