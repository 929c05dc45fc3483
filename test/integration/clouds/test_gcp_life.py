# SPDX-License-Identifier: Apache-2.0
"""Google's own rules: who reaches an instance, and how it ends."""

from __future__ import annotations

import shlex

import pytest

from fogros2.errors import MachineNotFound
from fogros2.model import MachineSpec, MachineState
from fogros2.provider import TAG_ON_EXIT
from fogros2.waiting import wait_until
from fogros2_testing import request_for
from rigs.computers.network import ROBOT_ELSEWHERE
from rigs.gce.resources import SERVICE_ACCOUNT

CLOUDS = ('gcp',)
pytestmark = pytest.mark.soak


def test_denial_keeps_out_whom_google_admits(provider, robot, box, make, name):
    machine = make(name)
    (instance,) = box.alive()
    connect = ['python3', '-c', 'import socket, sys; socket.create_connection('
               '(sys.argv[1], 22), 2).close()', instance.public]
    assert box.move_robot() == ROBOT_ELSEWHERE  # not admitted: a stranger
    try:
        assert robot.run(connect).returncode != 0
        # Google's default rules admit it: without our denial, it would reach the SSH server
        provider.cloud._account.remove(
            f'robots/global/firewalls/{box.things()["instances"][0]}-deny', 'a test')
        assert robot.run(connect).returncode == 0
    finally:
        box.move_robot(back=True)
        provider.destroy(machine.id)


def test_pinned_host_key_stays_beside_the_guest_agent(provider, box, make, name):
    machine = make(name)
    (instance,) = box.alive()
    shown = box.run(instance.id, 'cat /etc/ssh/ssh_host_ed25519_key.pub')
    assert shown.split()[:2] == machine.endpoint.host_key.split()
    provider.destroy(machine.id)


@pytest.mark.parametrize('account', ['', SERVICE_ACCOUNT])
def test_machine_ends_itself_as_its_rights_allow(cloud, provider, box, make, name, account):
    machine = make(name, service_account=account)
    (instance,) = box.alive()
    box.run(instance.id, shlex.join(cloud.end_command(box, machine.end_command)), check=False)
    box.wait_for(instance.id, 'terminated' if account else 'stopped', timeout=60)
    # without the right to delete itself it is off, and its disk waits for gc
    with pytest.raises(MachineNotFound):
        wait_until(lambda: provider.describe(machine.id).state is MachineState.DELETED,
                   timeout=60, what='the end')
    assert ('disks' in box.things()) == (not account)
    attempt = machine.id.rpartition('/')[2]
    provider.cloud.sweep('', attempt)


def test_google_ends_a_machine_at_its_lifetime(provider, box, name):
    spec = MachineSpec(name, 'gcp', {}, lifetime=30.0)  # the shortest that Google takes
    machine = provider.create(spec, request_for(spec, **{TAG_ON_EXIT: 'delete'}))
    (instance,) = box.alive()
    box.wait_for(instance.id, 'terminated', timeout=40)
    provider.destroy(machine)
