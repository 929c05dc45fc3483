# SPDX-License-Identifier: Apache-2.0
"""
What it takes until nodes on both sides of a VPN know each other, and to keep it so, by middleware.

A robot and a machine in network namespaces, userspace WireGuard between them, each middleware with
the configuration of a launch, half of the participants on either host. Bytes are WireGuard's own,
its overhead included.

Participants of Fast DDS are nodes of rclpy, in one process for each host, with all topics and
services that nodes have. Those of the others are processes with one writer and one reader, which
one on the other side matches. What isn't on this computer is left out, and said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import ctypes
import dataclasses
import importlib
import importlib.util
import json
import os
from pathlib import Path
import signal
import sys
import tempfile
import threading
import time
from typing import Any, TYPE_CHECKING

from figures import Row, write

from fogros2.dds import DdsVendor
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds
from fogros2.dds.zenoh import Zenoh
from fogros2.errors import DeadlineExceeded
from fogros2.vpn.wireguard import WireGuard
from fogros2.waiting import wait_until

if TYPE_CHECKING:
    from rigs.vpn_lab import Child, Lab

LAB = Path(__file__).parents[1] / 'test/integration/vpn'
COUNTS = (10, 50, 100)
#: <linux/prctl.h>
_PR_SET_PDEATHSIG = 1
#: Seconds until all have to know all, and for which they are then listened to.
LIMIT, IDLE = 90.0, 10.0


# --- a participant ------------------------------------------------------------------------------

def participants(kind: str, count: int, sent: str, heard: str) -> None:
    """Be so many participants; each tells how many others it knows of when that changes."""
    if kind == 'fastdds':
        nodes(count, sent)
        return
    # once for all, before the first fork: processors are few
    for module in {'cyclonedds': ('builtin', 'idl', 'pub', 'sub')}.get(kind, ()):
        importlib.import_module(f'{kind}.{module}')
    number = 0
    for copy in range(1, count):
        if os.fork() == 0:
            number = copy
            # starved as they are, they shall not outlive the one that would end them
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
            break
    ended = threading.Event()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: ended.set())
    {'cyclonedds': cyclone, 'zenoh': zenoh}[kind](f'{sent}{number}', f'{heard}{number}', ended)
    if number == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        os.killpg(0, signal.SIGTERM)


def tell(known: int) -> None:
    """Say of how many others one knows."""
    os.write(1, f'{json.dumps({"discovered": known})}\n'.encode())


def cyclone(sent: str, heard: str, ended: threading.Event) -> None:
    """Be a Cyclone DDS participant until the event is set."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    text = dataclasses.make_dataclass(
        'String', [('data', str)], bases=(IdlStruct,), namespace={'__module__': __name__})
    participant = DomainParticipant(0)
    kept = [DataWriter(participant, Topic(participant, f'rt/{sent}', text)),
            DataReader(participant, Topic(participant, f'rt/{heard}', text))]
    others = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
    before = -1
    while not ended.wait(1.0):
        known = len(others.read(N=1000)) - 1
        if known != before:
            tell(known)
            before = known
    del kept


def nodes(count: int, name: str) -> None:
    """Be so many contexts of rclpy, each with one node, until a signal ends them."""
    import rclpy
    from rclpy.context import Context

    known = {}
    for number in range(count):
        context = Context()
        rclpy.init(args=[], context=context)
        known[rclpy.create_node(f'{name}_{number}', context=context)] = -1
    while True:
        for node, before in known.items():
            others = len(set(node.get_node_names())) - 1
            if others != before:
                known[node] = others
                tell(others)
        time.sleep(0.3)


def zenoh(sent: str, heard: str, ended: threading.Event) -> None:
    """Be a zenoh session, known by a token as rmw_zenoh's nodes are, until the event is set."""
    import zenoh as library

    known: set[str] = set()

    def learn(sample: Any) -> None:
        known.add(str(sample.key_expr))
        tell(len(known) - 1)

    config = library.Config.from_file(os.environ['ZENOH_SESSION_CONFIG_URI'])
    with library.open(config) as session:
        kept = [session.declare_publisher(sent),
                session.declare_subscriber(heard, lambda sample: None),
                session.liveliness().declare_token(f'known/{sent}'),
                session.liveliness().declare_subscriber('known/*', learn, history=True)]
        ended.wait()
        del kept


# --- the measurement ----------------------------------------------------------------------------

class Bench:
    """One middleware between two hosts."""

    def __init__(self, lab: Lab, vendor: DdsVendor, program: list[str]) -> None:
        self.lab = lab
        self.vendor = vendor
        self.program = program

    def routers(self) -> None:
        """Start what a launch has beside its nodes."""
        hosts = {host: self.lab.interfaces[host].address for host in ('robot', 'machine')}
        for host, others in (('robot', [hosts['machine']]), ('machine', [])):
            made = self.vendor.router(hosts[host], others, {} if host == 'robot' else None)
            if made is not None:
                path = self.lab.folder / f'{host}.router.json5'
                path.write_text(made.config)
                self.lab.start(host, [sys.executable, str(LAB / 'zenoh_node.py'), 'router'],
                               **{made.variable: str(path)}).wait('ready', timeout=20.0)

    def start(self, host: str, count: int, words: list[str]) -> Child:
        """Start so many participants on a host."""
        return self.lab.start(host, [*self.program, str(count), *words],
                              ROS_LOG_DIR=str(self.lab.folder), **self.lab.configure(host))

    def measure(self, count: int) -> tuple[float, float, float, float]:
        """Return who knows all, seconds and bytes until then, and bytes a second from then on."""
        self.routers()
        before, begin = self.lab.carried('robot'), time.monotonic()
        children = [self.start('robot', count // 2, ['up', 'down']),
                    self.start('machine', count // 2, ['down', 'up'])]

        def complete() -> bool:
            return who() >= count

        def who() -> int:
            return sum(len(child.lines('discovered', count - 1)) for child in children)

        with contextlib.suppress(DeadlineExceeded):
            wait_until(complete, timeout=LIMIT, what=f'{count} participants to know each other')
        took, found = time.monotonic() - begin, self.lab.carried('robot')
        ended = threading.Event()
        ended.wait(3.0)  # what was still under way
        quiet = self.lab.carried('robot')
        ended.wait(IDLE)
        return min(count, who()), took, found - before, (
            self.lab.carried('robot') - quiet) / IDLE


@contextlib.contextmanager
def laboratory(vendor: DdsVendor) -> Iterator[Lab]:
    """Yield a robot and a machine with the VPN between them, for nodes with a middleware."""
    sys.path.insert(0, str(LAB.parents[1]))
    from rigs.vpn_lab import Lab
    with tempfile.TemporaryDirectory() as folder:
        lab = Lab(Path(folder))
        lab.dds, lab.vpn = vendor, WireGuard(ports=vendor.ports)
        try:
            lab.open()
            lab.connect()
            yield lab
        finally:
            lab.close()


def main() -> None:
    """Measure every middleware that is here."""
    me = [sys.executable, str(Path(__file__).resolve()), 'participants']
    rows = []
    for name, make, module, kind in (
            ('Cyclone DDS', CycloneDds, 'cyclonedds', 'cyclonedds'),
            ('Fast DDS', FastDds, 'rclpy', 'fastdds'), ('zenoh', Zenoh, 'zenoh', 'zenoh')):
        if importlib.util.find_spec(module) is None:
            print(f'{name} is not on this computer')
            continue
        rows += measured(name, make, [*me, kind])
    write('discovery', 'Discovery over the VPN', rows)


def measured(name: str, make: Callable[[], DdsVendor], words: list[str]) -> list[Row]:
    """Return the rows of one middleware."""
    rows = []
    for count in COUNTS:
        vendor = make()
        with laboratory(vendor) as lab:
            knowing, took, found, idle = Bench(lab, vendor, words).measure(count)
        print(f'{name} {count}: {knowing} know all, {took:.1f} s, {found / 1e3:.0f} kB, '
              f'{idle / 1e3:.2f} kB/s', flush=True)
        what = f'{name}, {count} participants'
        rows += [Row(f'{what}: know all the others', knowing, 'participants', count, 'more'),
                 Row(f'{what}: until all know all', found / 1e3, 'kB'),
                 Row(f'{what}: from then on', idle / 1e3, 'kB/s'),
                 Row(f'{what}: until all know all', took, 's')]
    return rows


if __name__ == '__main__':
    if sys.argv[1:2] == ['participants']:
        participants(sys.argv[2], int(sys.argv[3]), sys.argv[4], sys.argv[5])
    else:
        main()
