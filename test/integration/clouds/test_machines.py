# SPDX-License-Identifier: Apache-2.0
"""Machines of each cloud without a launch: strangers, the notice, a cancel, a stop."""

from __future__ import annotations

import shlex
import sys
import threading

import pytest

from fogros2.errors import FogError, MachineNotFound
from fogros2.model import MachineState
from fogros2.waiting import wait_until

pytestmark = pytest.mark.soak

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


def scan(robot, address):
    done = robot.run([sys.executable, '-ISc', SCAN, address])
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_stranger_finds_no_open_port(provider, robot, box, make, name):
    machine = make(name)
    (instance,) = box.alive()
    assert scan(robot, instance.public) == '[22]'  # the robot's own view
    box.move_robot()  # to an address that is not admitted: a stranger
    try:
        assert scan(robot, instance.public) == '[]'
    finally:
        box.move_robot(back=True)
    provider.allow(machine.id, 22, [])
    assert scan(robot, instance.public) == '[]'
    provider.destroy(machine.id)


def test_machine_beside_another_is_a_stranger(cloud, provider, box, make, name):
    machines = [make(f'{name}-{letter}') for letter in 'ab']
    one, two = sorted(box.alive(), key=lambda found: cloud.tags(found)['fogros2-name'])
    for address in (two.public, two.private):
        assert box.run(one.id, f"python3 -ISc '{SCAN}' {address}").strip() == '[]'
    for machine in machines:
        provider.destroy(machine.id)


def test_cancelled_creation_leaves_nothing(provider, box, make, name):
    box.set_boot_delay(8.0)
    provider.cancel = threading.Event()
    threading.Timer(1.0, provider.cancel.set).start()
    with pytest.raises(FogError):
        provider.destroy(make(name).id)
    # the request may have been over: the robot knows the machine by its tags then
    provider.cancel = None
    for machine in provider.find({'fogros2-name': name}):
        provider.destroy(machine.id)
    wait_until(lambda: not box.alive(), timeout=60, what='the machine to end')


def test_spot_machine_gets_the_notice_and_is_deleted(provider, box, make, name):
    machine = make(name, spot=True)
    (instance,) = box.alive()
    notice = provider.capabilities_of(machine).preemption_notice

    def noticed():
        return 'NOTICED' in box.run(
            instance.id, f'{shlex.join(notice)} && echo NOTICED', check=False)

    assert not noticed() and not provider.reclaims(machine.id)
    box.interrupt(instance.id, notice=4.0)
    assert noticed()
    assert provider.reclaims(machine.id) == (provider.name == 'aws')
    box.wait_for(instance.id, 'terminated', timeout=60)
    with pytest.raises(MachineNotFound):
        wait_until(lambda: provider.describe(machine.id).state is MachineState.DELETED,
                   timeout=60, what='the end')
        assert provider.reclaims(machine.id)
        raise MachineNotFound('EC2 still reports an instance that has ended')
    provider.destroy(machine.id)


def test_stopped_machine_keeps_its_disk(provider, box, make, name):
    machine = make(name, on_exit='stop')
    (instance,) = box.alive()
    box.run(instance.id, 'echo kept >/root/kept; sync')
    provider.stop(machine.id)
    box.wait_for(instance.id, 'stopped', 'deallocated')
    wait_until(lambda: provider.describe(machine.id).state is MachineState.STOPPED, timeout=60,
               what='the stop to be reported')
    provider.start(machine.id)
    box.wait_for(instance.id, 'running', computer=True)
    assert provider.reachable(machine.id, name=name, timeout=60).shell.host_key \
        == machine.shell.host_key
    assert box.run(instance.id, 'cat /root/kept').strip() == 'kept'
    provider.destroy(machine.id)
    with pytest.raises(MachineNotFound):
        wait_until(lambda: provider.describe(machine.id).state is MachineState.DELETED,
                   timeout=60, what='the end')
        raise MachineNotFound('EC2 still reports an instance that has ended')
