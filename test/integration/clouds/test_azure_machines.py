# SPDX-License-Identifier: Apache-2.0
"""How machines at Azure end their own billing, as their rights allow."""

from __future__ import annotations

import dataclasses
import shlex

import pytest

from fogros2.errors import MachineNotFound
from fogros2.model import MachineState
from fogros2.waiting import wait_until

CLOUDS = ('azure',)
pytestmark = pytest.mark.soak


def test_machine_without_the_right_is_off_and_billed(robot, box, name):
    box.set_rights(owner=False)
    run = robot.own(name)
    run.wait_for('I heard: ')
    # the lifetime is eight hours
    assert 'powers itself off and is billed' in run.text and 'at most $0.30' in run.text
    (machine,) = box.alive()
    run.kill()
    box.wait_for(machine.id, 'stopped', timeout=60)
    assert any('/schedules/' in path for path in box.things()['resources'])
    deleted = robot.ros2('fog', 'delete', '--yes', 'all')
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert robot.things() == []


def test_machine_waits_until_its_role_works(cloud, box, make, name):
    box.set_rights(owner=True, propagation=600.0)
    machine = make(name)
    (instance,) = box.alive()
    # a machine's uptime is that of this computer here
    young = dataclasses.replace(machine, end_command=tuple(
        word.replace('/proc/uptime', '/tmp/uptime') for word in machine.end_command))
    box.run(instance.id, 'echo 60.0 60.0 >/tmp/uptime')
    ends = shlex.join(cloud.end_command(box, young.end_command))
    assert 'status=1' in box.run(instance.id, f'{ends} || echo status=$?')
    box.set_rights(owner=True)
    assert 'status' not in box.run(instance.id, f'{ends} || echo status=$?',
                                   check=False)
    wait_until(lambda: not box.things()['groups'], timeout=60, what='its group to be deleted')


def test_machine_that_stops_at_its_end_deallocates_itself(cloud, provider, box, make, name):
    machine = make(name, on_exit='stop')
    (instance,) = box.alive()
    box.run(instance.id, 'echo kept >/root/kept')
    box.run(instance.id, shlex.join(cloud.end_command(box, machine.end_command)), check=False)
    box.wait_for(instance.id, 'deallocated')
    assert provider.describe(machine.id).state is MachineState.STOPPED
    provider.start(machine.id)
    box.wait_for(instance.id, 'running', computer=True)
    assert provider.reachable(machine.id, name=name, timeout=60).endpoint == machine.endpoint
    assert box.run(instance.id, 'cat /root/kept').strip() == 'kept'
    provider.destroy(machine.id)
    with pytest.raises(MachineNotFound):
        provider.describe(machine.id)


def test_machine_may_do_nothing_else(cloud, provider, box, make, name):
    one, two = make(f'{name}-a'), make(f'{name}-b')
    instance = next(i for i in box.alive() if i.tags['fogros2-name'] == f'{name}-a')
    # its command, with the other machine's group
    changed = dataclasses.replace(one, end_command=tuple(word.replace(
        "me['resourceId'].split('/providers/')[0]",
        f"me['resourceId'].split('/resourceGroups/')[0] + '/resourceGroups/"
        f"{two.id.split('/')[1]}'").replace('subprocess.run', 'print')
        for word in one.end_command))
    box.run(instance.id, shlex.join(cloud.end_command(box, changed.end_command)), check=False)
    assert box.calls()[-1].error == 'AuthorizationFailed'
    assert len(box.things()['groups']) == 2
    for machine in (one, two):
        provider.destroy(machine.id)
