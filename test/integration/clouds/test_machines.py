# SPDX-License-Identifier: Apache-2.0
"""Machines of each cloud without a launch: what strangers reach."""

from __future__ import annotations

import sys

import pytest

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
