# SPDX-License-Identifier: Apache-2.0
"""
H.264 images over 10 Mbit/s to a container machine whose VPN goes by UDP, and by SSH.

All packets between the two hosts go through a program, which limits the rate both ways, and in two
cases delays and loses packets of both protocols. ``--count`` is the number of images of a case.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fcntl
import json
import os
from pathlib import Path
import random
import struct
import subprocess
import sys
import time
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / 'test')]

from streaming import Case, launched, Link, prepare, run  # noqa: E402

import relay  # noqa: E402

DEVICE = 'fogtpath'
#: The name of a path's figures.
NAMES = {'udp': 'UDP', 'stream': 'SSH connection'}
#: Cases of each path, by what their names add: delay each way in seconds, and loss.
LINKS = {'': (0.0, 0.0), ', 20 ms and 1 % loss': (0.02, 0.01)}
#: linux/if_tun.h
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454ca, 1, 0x1000
#: Bytes of the headers of IPv4 and UDP, which the relay's own packets lack.
HEADERS = 28


# --- the link -----------------------------------------------------------------------------------

def tun(route: str, source: str) -> int:
    """Make a device in the current network namespace, and lead an address there."""
    handle = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(handle, TUNSETIFF, struct.pack('16sH22x', DEVICE.encode(), IFF_TUN | IFF_NO_PI))
    for words in (('link', 'set', DEVICE, 'up'),
                  ('route', 'add', f'{route}/32', 'dev', DEVICE, 'src', source)):
        subprocess.run(['ip', *words], check=True)
    return handle


async def carry(robot: str, machine: str, process: str) -> None:
    """Carry packets between two hosts; each line of standard input has settings."""
    from rigs.computers import netns

    here = tun(machine, robot)
    netns._enter(f'/proc/{process}/ns/net')
    there = tun(robot, machine)
    pending, chance = relay.Pending(), random.Random(1)
    links = {here: relay.Link(), there: relay.Link()}
    counters = {'passed': 0, 'lost': 0}

    def deliver(end: int, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(end, data)

    def read(begin: int, end: int) -> None:
        with contextlib.suppress(BlockingIOError):
            while data := os.read(begin, 65536):
                when = links[begin].schedule(len(data) - HEADERS, time.monotonic(), chance)
                counters['passed' if when is not None else 'lost'] += 1
                if when is not None:
                    pending.add(when, lambda data=data: deliver(end, data))  # type: ignore

    loop = asyncio.get_running_loop()
    loop.add_reader(here, read, here, there)
    loop.add_reader(there, read, there, here)
    print('ready', flush=True)
    while line := await loop.run_in_executor(None, sys.stdin.readline):
        for link in links.values():
            vars(link).update(json.loads(line))
        print(json.dumps(counters), flush=True)


class Path10(Link):
    """The link between the robot and a container machine, as ``streaming.run`` needs it."""

    def __init__(self, launch: Any, machine: Any) -> None:
        self.interface = f'fog{launch.id}'
        name = f'fogros2-{machine.spec.name}'
        host = machine.machine.endpoint.host
        pid = _printed('podman', 'inspect', '--format', '{{.State.Pid}}', name)
        robot = _printed('ip', '-o', 'route', 'get', host).split(' src ')[1].split()[0]
        self.process = subprocess.Popen(
            [sys.executable, __file__, '--carry', robot, host, pid],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        if self.process.stdout.readline() != 'ready\n':
            raise RuntimeError('the link has no device')


def _printed(*words: str) -> str:
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip()


# --- the measurement ----------------------------------------------------------------------------

def measure(path: str, count: int) -> dict[str, Any]:
    """Return the outcomes of a path's cases by their names."""
    outcomes = {}
    with launched(
            f'bench-path-{path}', prepare, Path10,
            {'vpn_path': {'vpn_path': path}}) as (launch, machine, link, output):
        for name, (delay, loss) in LINKS.items():
            case = Case(f'H.264, {NAMES[path]}{name}', 'h264', delay=delay, loss=loss)
            outcomes[name] = run(case, launch, machine, link, output, count, '')
            print(outcomes[name], flush=True)
    return outcomes


def main() -> None:
    """Measure both paths in turn, write the figures down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=1800)
    parser.add_argument('--carry', nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.carry:
        return asyncio.run(carry(*arguments.carry))
    if os.geteuid():
        print('not measured: the link between two hosts needs root')
        return None
    from figures import machine as computer
    from figures import RESULTS, Row, write

    outcomes = {path: measure(path, arguments.count) for path in NAMES}
    rows = []
    for name in LINKS:
        for path, by_link in outcomes.items():
            one = by_link[name]
            goal = 29.5 if path == 'stream' and not name else None
            rows += [Row(f'{one.case.name}: images', one.fps, '1/s', goal, 'more', runs=1),
                     Row(f'{one.case.name}: median', one.median, 'ms', runs=1, high=one.p95)]
        rows.append(Row(
            f"{NAMES['stream']} over UDP{name}: median",
            outcomes['stream'][name].median / outcomes['udp'][name].median, '',
            None if name else 2.0))
    write('vpn_path', 'H.264 over 10 Mbit/s, the VPN by UDP and by the SSH connection', rows,
          RESULTS, f'{computer()}, {arguments.count} images of each')
    return None


if __name__ == '__main__':
    main()
