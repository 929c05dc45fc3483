# SPDX-License-Identifier: Apache-2.0
"""Launches in each cloud, from nothing to messages to nothing, and what goes wrong there."""

from __future__ import annotations

import base64
import contextlib
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import time

import pytest

from fogros2.deploy.steps.watching import POLL_INTERVAL
from fogros2.waiting import wait_until
from rigs.computers.network import ROBOT

CHECK = Path(__file__).resolve().parents[3] / 'tools' / 'cloud_check.py'
#: What a cloud may be asked for one launch at the most, from its beginning to its end.
CALLS = 25
TWO = '''\
from fogros2 import {machine}, CloudNode, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    one, two = ({machine}(name=name, **options) for name, options in zip(
        ('{name}-one', '{name}-two'), {places!r}))
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        CloudNode(machine=one, executable='talker', **words),
        CloudNode(machine=two, executable='listener', **words),
        Node(executable='listener', name='here', **words),
    ])
'''
#: Answers on an instance as an engine's published ports do, and where nobody may come.
PORTS = """
import selectors, socket
with selectors.DefaultSelector() as chosen:
    for port in 40000, 8000:
        for kind in socket.SOCK_STREAM, socket.SOCK_DGRAM:
            one = socket.socket(socket.AF_INET, kind)
            one.bind(('', port))
            if kind is socket.SOCK_STREAM:
                one.listen()
            chosen.register(one, selectors.EVENT_READ)
    while True:
        for key, _ in chosen.select():
            if key.fileobj.type is socket.SOCK_STREAM:
                key.fileobj.accept()[0].close()
            else:
                key.fileobj.sendto(b'answer', key.fileobj.recvfrom(9)[1])
"""
#: Prints which of those ports answer at an address.
ASK = """
import socket, sys
for port in 40000, 8000:
    for kind in socket.SOCK_STREAM, socket.SOCK_DGRAM:
        with socket.socket(socket.AF_INET, kind) as one:
            one.settimeout(2)
            try:
                one.connect((sys.argv[1], port))
                one.send(b'ask')
                if kind is socket.SOCK_STREAM or one.recv(9):
                    print(port, kind.name[5:])
            except OSError:
                pass
"""
#: Has a rebooted instance's agent start something.
ASK_AGENT = """
[ -e /run/before ] || echo '{"id": 1, "command": "start", "nodes": []}' |
    python3 -IS /opt/fogros2/agent.py connect --directory /run/fogros2
"""


def test_talker_from_nothing_to_nothing(cloud, robot, box, name):
    begin = time.monotonic()
    run = robot.talker(name)
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    assert (instance.type, instance.region, instance.state) == (
        cloud.kind, cloud.region, 'running')
    tags = cloud.tags(instance)
    assert tags['fogros2-name'] == name
    # the host key that went through user data is nobody's any more
    now = box.run(instance.id, 'cat /etc/ssh/ssh_host_ed25519_key.pub').split()[1]
    assert now in tags['fogros2-host-key']
    # SSH goes through the VPN by now, and its port is closed to everybody
    run.wait_for('port 22 closed')
    before = len(cloud.asked(box))
    cloud.look(box, instance, name)
    looked = len(cloud.asked(box)) - before
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
    assert run.clean, run.text
    if cloud.price:
        assert f'{name}: ' in run.text and f'h at ${cloud.price} an hour, $' in run.text
    asked = cloud.asked(box)
    # it looks at its machine as long as that runs
    assert len(asked) - looked <= CALLS + (time.monotonic() - begin) / POLL_INTERVAL, asked


@pytest.mark.soak
def test_machines_of_two_places_hear_each_other(cloud, robot, box, name):
    run = robot.launch(robot.write('two.launch.py', TWO.format(
        machine=cloud.machine, name=name, places=cloud.places)))
    run.wait_for(f'[listener]: I heard: [Hello World from {name}-one ')
    run.wait_for(f'[here]: I heard: [Hello World from {name}-one ')
    found = {cloud.tags(one)['fogros2-name']: one for one in box.alive()}
    there = found[f'{name}-two']
    assert len(found) == 2 and there.type in (*cloud.places[1].values(), cloud.kind)
    assert {there.region, there.zone} & {*cloud.places[1].values()}
    run.interrupt()
    assert run.ended() == 0, run.text
    assert run.clean, run.text


@pytest.mark.soak
def test_kept_machine_is_baked_listed_and_deleted_elsewhere(cloud, robot, box, name):
    run = robot.talker(name, 'on_exit:=keep', 'count:=1')
    assert run.ended() == 0, run.text
    (kept,) = box.alive()
    box.run(kept.id, 'echo baked >/root/baked; sync')
    shown = robot.ros2('fog', 'image', name, '--dry-run')
    assert shown.returncode == 0 and f'would make an image of {name}' in shown.stderr
    assert json.loads(robot.fog('image', 'list', '--json'))['images'] == []
    robot.fog('image', name)
    # a computer that knows nothing of this robot's machines finds this one, and ends it
    elsewhere = {'FOGROS2_STATE_HOME': str(robot.home / 'elsewhere')}
    before = len(cloud.asked(box))
    (found,) = [one for one in json.loads(robot.fog('list', '--json', **elsewhere))['machines']
                if one['name'] == name]
    assert (found['provider'], found['disk_gb']) == (cloud.name, 30)
    assert len(cloud.asked(box)) - before <= cloud.listing
    assert cloud.name in robot.fog('doctor', '--provider', cloud.name)
    robot.fog('delete', '--yes', name, **elsewhere)
    assert not box.alive()
    # the robot that made it finds nothing to delete but its own memory
    robot.fog('delete', '--yes', name)
    again = robot.talker(f'{name}-b', 'on_exit:=keep', 'count:=1')
    assert again.ended() == 0, again.text
    assert again.clean, again.text
    assert box.run(box.alive()[0].id, 'cat /root/baked').strip() == 'baked'
    robot.fog('delete', '--yes', f'{name}-b')
    (image,) = json.loads(robot.fog('image', 'list', '--json'))['images']
    robot.fog('image', 'delete', image['id'], '--yes')
    assert not robot.things()


@pytest.mark.soak
def test_kept_machine_is_a_host_for_the_robots_of_its_fleet(cloud, robot, box, name, tmp_path):
    key = tmp_path / 'robot two'
    subprocess.run(['ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-f', key], check=True)
    options = {'fleet': [key.with_suffix('.pub').read_text().strip()],
               'ssh_from': [f'{ROBOT}/32'], 'on_exit': 'keep'}
    run = robot.own(name, options)
    run.wait_for(f'I heard: [Hello World from {name} ')
    run.wait_for('SSH through the VPN, and open to ')
    (instance,) = box.alive()
    box.run(instance.id, f'cat >/root/ports.py <<END\n{PORTS}\nEND\n'
                         'setsid python3 /root/ports.py >/dev/null 2>&1 &')

    (told,) = [one for one in json.loads(robot.fog('list', '--json'))['machines']
               if one['name'] == name]
    known = tmp_path / 'known'
    known.write_text(f"{told['address']} {told['host_key']}\n")

    def reached():
        done = robot.run([
            'ssh', '-i', str(key), '-F', '/dev/null', '-o', 'BatchMode=yes',
            '-o', 'ConnectTimeout=10', '-o', 'StrictHostKeyChecking=yes',
            '-o', f'UserKnownHostsFile={known}', f'ubuntu@{instance.public}', 'sudo whoami'])
        asked = robot.run([sys.executable, '-c', ASK, instance.public])
        return [*done.stdout.split(), *asked.stdout.splitlines()]

    wait_until(lambda: len(reached()) == 3, timeout=60, what='the ports to answer')
    run.interrupt()
    assert run.ended() == 0, run.text
    assert reached() == ['root', '40000 STREAM', '40000 DGRAM']
    again = robot.own(name, options)
    again.wait_for(f'I heard: [Hello World from {name} ')
    again.interrupt()
    assert again.ended() == 0, again.text
    assert [one.id for one in box.alive()] == [instance.id]
    robot.fog('connect', name, '--', 'true')  # opens the port, and closes it
    assert reached() == ['root', '40000 STREAM', '40000 DGRAM']
    box.move_robot()  # to an address that is not admitted
    try:
        assert reached() == []
    finally:
        box.move_robot(back=True)
    # after a reboot, it waits for no launch, which would end it
    box.run(instance.id, 'touch /run/before; reboot', check=False)
    wait_until(lambda: 'no launch has this machine' in box.run(
        instance.id, ASK_AGENT, check=False), timeout=60, what='the agent after the reboot')
    robot.fog('delete', '--yes', name)


@pytest.mark.soak
@pytest.mark.parametrize('cloud', ['aws'], indirect=True, scope='session')
def test_robot_that_moves_during_the_boot_is_let_in(cloud, robot, box, name):
    box.set_boot_delay(5.0)
    run = robot.launch('fogros2_examples', 'talker.aws.launch.py', f'name:={name}', 'count:=1')
    wait_until(box.alive, timeout=60, what='an instance')
    box.move_robot()
    try:
        assert run.ended() == 0, run.text
        assert run.clean, run.text
    finally:
        box.move_robot(back=True)


@pytest.mark.soak
def test_new_spot_machine_replaces_a_reclaimed_one(cloud, robot, box, name):
    """The old machine is deleted before another one gets its name."""
    run = robot.own(name, {'spot': True, 'on_interrupt': 'replace'})
    run.wait_for(f'I heard: [Hello World from {name} ')
    (first,) = box.alive()
    box.interrupt(first.id, notice=30.0)
    run.wait_for(f'{name}: the machine reports that its provider reclaims it')
    # EC2 confirms the notice at once, the others show the machine's end
    run.wait_for(f"the machine '{name}' is {'being reclaimed' if cloud.name == 'aws' else ''}",
                 timeout=60)
    run.wait_for(f'I heard: [Hello World from {os.uname().nodename} ')
    run.wait_for(f'{name}: a new machine runs the nodes')
    heard = run.text.count(f'I heard: [Hello World from {name} ')
    run.wait_for(f'I heard: [Hello World from {name} ', times=heard + 1)
    (second,) = box.alive()
    assert second.id != first.id and second.spot
    run.interrupt()
    assert run.ended() == 0, run.text
    wait_until(lambda: not robot.things(), timeout=60, what='nothing to be left')


@pytest.mark.soak
def test_machine_ends_whose_robot_was_killed(cloud, robot, box, name):
    run = robot.own(name)
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    run.kill()
    box.wait_for(instance.id, 'terminated', 'stopped', timeout=60)
    if cloud.name == 'azure':
        wait_until(lambda: not robot.things(), timeout=60, what='its group, which it deletes')
    # what the machine can't take along goes with the robot's record of it
    robot.fog('gc')
    robot.fog('delete', '--yes', 'all')
    wait_until(lambda: not box.alive() and not robot.things(), timeout=60,
               what='nothing to be left')


def interrupted(cloud, robot, box, name, seconds):
    """Return a launch that was interrupted while a request was under way."""
    box.slow(cloud.order, seconds)
    before = box.held()
    run = robot.own(name)
    wait_until(lambda: run.child.poll() is not None or box.held() > before, timeout=60,
               longest=0.05, what='the request for a machine')
    assert run.child.poll() is None, run.text
    run.interrupt()
    return run


@pytest.mark.parametrize('cloud', [
    'aws', *(pytest.param(name, marks=pytest.mark.soak) for name in ('azure', 'gcp'))],
    indirect=True, scope='session')
def test_interrupted_request_for_a_machine_leaves_none(cloud, robot, box, name):
    run = interrupted(cloud, robot, box, name, 4.0)
    assert run.ended() == 0, run.text
    assert run.errors == [] and box.alive() == [] and not box.held()
    assert robot.fog('gc') == 'nothing to clear\n'


@pytest.mark.parametrize('cloud', [
    'gcp', *(pytest.param(name, marks=pytest.mark.soak) for name in ('aws', 'azure'))],
    indirect=True, scope='session')
def test_machine_that_appears_after_its_launch_is_cleared(cloud, robot, box, name):
    """The launch does not wait for ever; one that is killed does not wait at all."""
    killed, ended = (interrupted(cloud, robot, box, f'{name}-{what}', 300.0)
                     for what in ('killed', 'ended'))
    killed.kill()
    # where the cloud needs what the launch has deleted by now, no machine can appear
    assert (ended.ended() == 1) == (cloud.name != 'azure'), ended.text
    assert (f"'{name}-ended' may still appear" in ended.text) == (cloud.name != 'azure')
    assert 'Traceback' not in ended.text
    early = robot.ros2('fog', 'gc')
    assert f"could not clear machine {name}-killed: '{name}-killed' may still appear" \
        in early.stdout and early.returncode == 1
    box.slow()
    wait_until(lambda: box.held() == 0, timeout=60, what='the requests to be carried out')
    assert len(box.alive()) == (2 if cloud.name == 'gcp' else 0)
    late = robot.ros2('fog', 'gc')
    assert (late.returncode == 0) == (cloud.name == 'gcp'), late.stdout
    assert box.alive() == []


@pytest.mark.soak
def test_cloud_check_runs_the_talker_and_deletes_it(cloud, robot, box):
    done = robot.run([sys.executable, str(CHECK), cloud.name], YES='1')
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == '' and cloud.checked in done.stdout
    if cloud.price:
        assert re.search(r'-- cost: at most \$0\.\d+ \(\d+ s at \$0\.\d+ an hour\)', done.stdout)
    assert f'{cloud.name} works: 5 messages arrived, and nothing is left.' in done.stdout
    assert box.alive() == [] and not robot.things()


def places(robot, box, instance, run, secrets):
    """Return where somebody else could read one of the secrets."""
    # the words that look for a secret must not have it
    coded = base64.b64encode('\n'.join(secrets).encode()).decode()
    there = box.run(instance.id, (
        f'echo {coded} | base64 -d | grep -rlFsf - /etc /home /root /opt /run /tmp /var /dev/shm '
        '/proc/[0-9]*/environ /proc/[0-9]*/cmdline || :'))
    shown = {'tags': robot.cloud.described(box), 'output': run.text}
    for path in (*Path('/proc').glob('[0-9]*/cmdline'), *(robot.home / 'state').rglob('*'),
                 *(robot.home / 'log').rglob('*')):
        with contextlib.suppress(OSError):
            shown[str(path)] = path.read_text(errors='replace')
    return sorted([*there.split(), *(
        where for where, text in shown.items() if any(one in text for one in secrets))])


@pytest.mark.soak
def test_secrets_stay_with_the_robot(cloud, robot, box, name):
    run = robot.own(name, FOGROS2_STATE_HOME=str(robot.home / 'state'))
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    secrets = cloud.secrets(robot.variables)
    assert places(robot, box, instance, run, secrets) == []
    assert 'OPENSSH PRIVATE KEY' not in cloud.described(box) + run.text
    # the scan sees what somebody has planted: on the machine, in its processes, in the state
    planted = robot.home / 'state' / 'planted'
    planted.write_text(secrets[0])
    box.run(instance.id, f"echo '{secrets[0]}' >/var/tmp/planted; "
                         f"PLANTED='{secrets[0]}' setsid sleep 60 >/dev/null 2>&1 & sleep 0.2")
    found = places(robot, box, instance, run, secrets)
    assert {str(planted), '/var/tmp/planted'} <= set(found)
    assert any(re.fullmatch('/proc/[0-9]+/environ', where) for where in found)
    run.interrupt()
    assert run.ended() == 0, run.text
