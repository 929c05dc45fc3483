#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A UDP relay that stands for a bad network between two hosts: delay, jitter, loss, cuts, a rate.

As a program it listens at one address and passes packets to another; each client gets a socket
of its own there, so that the far side sees what it would see behind a NAT. Settings change while
it runs: one JSON object a line on standard input, such as ``{"loss": 0.05}`` or ``{"cut": true}``
or ``{"rebind": true}`` or ``{"source": "198.51.100.9"}``, this computer's address that the far
side sees from then on; each is answered with a line of counters. It ends with its standard input
or with its lifetime.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Callable
import ctypes
import dataclasses
import heapq
import itertools
import json
import os
import random
import socket
import struct
import sys
import time
from typing import Any, Optional

Address = tuple[str, int]
#: Bytes of Ethernet, IPv4 and UDP headers that a packet takes on the wire.
OVERHEAD = 42
#: Packets under way at once; more are lost, so that a mistake can't fill the memory.
MOST = 20_000
#: Packets taken from a socket at a time, and bytes that it holds meanwhile.
BATCH, BUFFER = 64, 4 << 20


@dataclasses.dataclass
class Link:
    """
    How one direction of the relay treats its packets.

    :param delay: seconds that each packet takes.
    :param jitter: seconds; each packet takes up to so much more or less, and overtakes others.
    :param loss: probability from 0 to 1.
    :param rate: bits per second, headers included; 0 for no limit.
    :param queue: seconds that a packet waits at the most for its turn at that rate.
    :param cut: lose everything.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    rate: float = 0.0
    queue: float = 0.1
    cut: bool = False
    free: float = 0.0

    def schedule(self, size: int, now: float, chance: random.Random) -> Optional[float]:
        """Return when a packet of so many bytes arrives (on ``now``'s clock); None: never."""
        if self.cut or chance.random() < self.loss:
            return None
        if self.rate:
            begin = max(now, self.free)
            if begin - now > self.queue:
                return None
            self.free = begin + (size + OVERHEAD) * 8 / self.rate
            now = self.free
        return now + max(0.0, self.delay + chance.uniform(-self.jitter, self.jitter))


class Pending:
    """
    Packets under way, each delivered at its time to some hundredths of a millisecond.

    An event loop's own timers wait for whole milliseconds, more than a small packet takes at
    10 Mbit/s: Linux's timerfd does better (timerfd_create(2)). Python has it from 3.13 on.
    """

    _CLOCK_MONOTONIC, _ABSOLUTE = 1, 1

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._timer = self._checked(self._libc.timerfd_create(
            self._CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC))
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()
        asyncio.get_running_loop().add_reader(self._timer, self._due)

    def __len__(self) -> int:
        return len(self._queue)

    def add(self, when: float, deliver: Callable[[], None]) -> None:
        """Call ``deliver`` at a time of ``time.monotonic()``."""
        first = not self._queue or when < self._queue[0][0]
        heapq.heappush(self._queue, (when, next(self._number), deliver))
        if first:
            self._set()

    def close(self) -> None:
        """Drop what is under way."""
        self._queue.clear()
        asyncio.get_running_loop().remove_reader(self._timer)
        os.close(self._timer)

    def _due(self) -> None:
        try:
            os.read(self._timer, 8)
        except BlockingIOError:
            return  # set anew meanwhile
        now = time.monotonic()
        while self._queue and self._queue[0][0] <= now:
            heapq.heappop(self._queue)[2]()
        if self._queue:
            self._set()

    def _set(self) -> None:
        # 0 would stop it
        nanoseconds = max(1, round(self._queue[0][0] * 1e9))
        # struct itimerspec: an interval, which is none, and the time; seconds, then nanoseconds
        setting = struct.pack('@llll', 0, 0, *divmod(nanoseconds, 10 ** 9))
        self._checked(self._libc.timerfd_settime(self._timer, self._ABSOLUTE, setting, None))

    @staticmethod
    def _checked(result: int) -> int:
        if result < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return result


class Relay:
    """A relay inside an event loop: ``await start()``, change ``up`` and ``down``, ``close()``."""

    def __init__(self, target: Address, *, seed: Optional[int] = None, **settings: Any) -> None:
        self.target = target
        #: From the clients to the target, and back.
        self.up, self.down = Link(**settings), Link(**settings)
        #: Address from which the target is dialled, '' for any.
        self.source = ''
        self.passed = self.lost = self.bytes = 0
        self._chance = random.Random(seed)
        self._inside: Optional[socket.socket] = None
        self._outside: dict[Address, socket.socket] = {}
        self._pending: Optional[Pending] = None

    async def start(self, listen: Address) -> Address:
        """Listen, and return the address (port 0 takes any)."""
        self._pending = Pending()
        self._inside = self._open(self._from_client)
        self._inside.bind(listen)
        address: Address = self._inside.getsockname()
        return address

    def close(self) -> None:
        """Drop everything."""
        self.rebind()
        if self._inside is not None:
            self._close(self._inside)
        if self._pending is not None:
            self._pending.close()
            self._pending = None

    def rebind(self) -> None:
        """Let the target see the clients at new addresses, as a NAT does that has forgotten."""
        for outside in self._outside.values():
            self._close(outside)
        self._outside.clear()

    def change(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Apply settings to both directions, or to ``up_...`` or ``down_...``; return counters."""
        for key, value in settings.items():
            side, _, name = key.partition('_')
            if key in ('rebind', 'source'):
                if key == 'source':
                    self.source = str(value)
                self.rebind()
                continue
            links = {'up': [self.up], 'down': [self.down]}.get(side, [self.up, self.down])
            for link in links:
                name = name if side in ('up', 'down') else key
                if not hasattr(link, name):
                    raise ValueError(f'no setting is called {key!r}')
                setattr(link, name, value)
        return {'passed': self.passed, 'lost': self.lost, 'bytes': self.bytes,
                'under_way': len(self._pending or ()), 'clients': len(self._outside)}

    def _from_client(self, data: bytes, client: Address) -> None:
        self._send(self.up, data, lambda: self._to_target(data, client))

    def _to_target(self, data: bytes, client: Address) -> None:
        outside = self._outside.get(client)
        if outside is None:
            outside = self._open(lambda back, _: self._from_target(back, client))
            if self.source:
                outside.bind((self.source, 0))
            self._outside[client] = outside
        self._put(outside, data, self.target)

    def _from_target(self, data: bytes, client: Address) -> None:
        inside = self._inside
        if inside is not None:
            self._send(self.down, data, lambda: self._put(inside, data, client))

    def _put(self, one: socket.socket, data: bytes, address: Address) -> None:
        try:
            one.sendto(data, address)
        except OSError:
            # nobody there at the moment, or a full buffer: networks lose packets without a word
            self.lost += 1

    def _open(self, take: Callable[[bytes, Address], None]) -> socket.socket:
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        one.setblocking(False)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            one.setsockopt(socket.SOL_SOCKET, option, BUFFER)

        def read() -> None:
            for _ in range(BATCH):
                try:
                    data, address = one.recvfrom(65535)
                except BlockingIOError:
                    return
                except ConnectionError:
                    continue
                take(data, address)

        asyncio.get_running_loop().add_reader(one, read)
        return one

    def _close(self, one: socket.socket) -> None:
        asyncio.get_running_loop().remove_reader(one)
        one.close()

    def _send(self, link: Link, data: bytes, deliver: Callable[[], None]) -> None:
        pending = self._pending
        if pending is None:
            return
        now = time.monotonic()
        when = link.schedule(len(data), now, self._chance)
        if when is None or len(pending) >= MOST:
            self.lost += 1
            return
        self.passed += 1
        self.bytes += len(data)
        if when <= now:
            deliver()
            return
        pending.add(when, deliver)


async def _control(relay: Relay, lifetime: float) -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    end = time.monotonic() + lifetime
    while True:
        try:
            line = await asyncio.wait_for(reader.readline(), end - time.monotonic())
        except asyncio.TimeoutError:
            return
        if not line:
            return
        try:
            answer = relay.change(json.loads(line))
        except ValueError as error:
            answer = {'error': str(error)}
        print(json.dumps(answer), flush=True)


async def _main(arguments: argparse.Namespace) -> None:
    relay = Relay(
        arguments.target, seed=arguments.seed, delay=arguments.delay, jitter=arguments.jitter,
        loss=arguments.loss, rate=arguments.rate)
    host, port = await relay.start(arguments.listen)
    print(json.dumps({'listen': f'{host}:{port}'}), flush=True)
    try:
        await _control(relay, arguments.lifetime)
    finally:
        relay.close()


def _address(text: str) -> Address:
    host, _, port = text.rpartition(':')
    return host, int(port)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('listen', type=_address, help='host:port; port 0 takes any')
    parser.add_argument('target', type=_address, help='host:port')
    parser.add_argument('--delay', type=float, default=0.0, help='seconds')
    parser.add_argument('--jitter', type=float, default=0.0, help='seconds, more or less')
    parser.add_argument('--loss', type=float, default=0.0, help='0 to 1')
    parser.add_argument('--rate', type=float, default=0.0, help='bits per second, 0: no limit')
    parser.add_argument('--seed', type=int, help='makes the losses the same each time')
    parser.add_argument('--lifetime', type=float, default=600.0, help='seconds until it ends')
    asyncio.run(_main(parser.parse_args()))
