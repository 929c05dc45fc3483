# SPDX-License-Identifier: Apache-2.0
"""
How long a second robot needs from ``ros2 fog join`` to the first message of a machine's node.

Two robots and a machine in network namespaces, the second robot behind a NAT. The reference is the
same node on the first robot, whose VPN is up, in the same run: what is more than that is joining.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import statistics
import sys
import tempfile
import time

from figures import Row, write

from fogros2 import invitation
from fogros2.invitation import Invitation
from fogros2.store import Store

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from rigs.vpn_guest import GUEST, Guest, OUTSIDE
from rigs.vpn_lab import Child, Lab, MACHINE, NETWORK, NODE, PORT

RUNS = 15
LISTEN = (sys.executable, str(NODE), 'from:/map')


@contextlib.contextmanager
def fleet(folder: Path) -> Iterator[Guest]:
    """Have both robots and the machine, whose node publishes each 10 ms."""
    lab = Lab(folder)
    try:
        lab.open()
        lab.connect()
        guest = Guest(lab)
        lab.node('machine', 'to:/map', '--period', '0.01')
        yield guest
    finally:
        lab.close()


def first(child: Child, begin: float) -> float:
    """Return the seconds until a node hears its first message, and end the node."""
    arrival = child.wait('topic', '/map', timeout=30.0)[0]['arrival']
    child.stop()
    return float(arrival) - begin


def invited(guest: Guest, store: Store) -> str:
    """Admit the second robot, with the key of its state folder, and return the invitation."""
    guest.key = invitation.public_text(invitation.own_key(store))
    guest.admit(3600.0)
    return invitation.seal(Invitation(
        'planner', guest.machine_key, MACHINE, f'{OUTSIDE}:{PORT}', GUEST, NETWORK,
        'rmw_cyclonedds_cpp', 0, time.time() + 3600), guest.key)


def main() -> None:
    """Take both in turn."""
    joined, alone, reference = [], [], []
    with tempfile.TemporaryDirectory() as folder, fleet(Path(folder)) as guest:
        lab, state = guest.lab, f'{folder}/second'
        text = invited(guest, Store(Path(state)))
        environment = {'FOGROS2_STATE_HOME': state}
        # compiled modules are there, as on a robot
        os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
        for number in range(RUNS + 1):
            begin = time.monotonic()
            child = lab.start('guest', [
                'sh', '-ec', f'eval "$(ros2 fog join {text})"; exec "$@"', 'sh', *LISTEN],
                **environment)
            seconds = first(child, begin)
            lab.start('guest', ['ros2', 'fog', 'leave', 'planner'], **environment).process.wait(30)
            begin = time.monotonic()
            lab.start('guest', ['ros2', 'fog', 'join', text], **environment).process.wait(30)
            only = time.monotonic() - begin
            lab.start('guest', ['ros2', 'fog', 'leave', 'planner'], **environment).process.wait(30)
            begin = time.monotonic()
            there = first(lab.node('robot', 'from:/map'), begin)
            if number:  # the first fills caches
                joined.append(seconds)
                alone.append(only)
                reference.append(there)
    write('fleet', 'A second robot joins a machine', [
        Row('ros2 fog join to the first message', statistics.median(joined), 's', 1.0, runs=RUNS),
        Row('ros2 fog join alone', statistics.median(alone), 's', runs=RUNS),
        Row('the same node on the first robot, whose VPN is up', statistics.median(reference),
            's', runs=RUNS),
        Row('joining, more than that node', statistics.median(
            one - other for one, other in zip(joined, reference)), 's', runs=RUNS)])


if __name__ == '__main__':
    main()
