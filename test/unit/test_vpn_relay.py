# SPDX-License-Identifier: Apache-2.0
"""The relay of the network tests does to packets what it says."""

from __future__ import annotations

import asyncio
import importlib.util
from pathlib import Path
import random
import socket
import sys
from types import ModuleType

import pytest

from rigs import loops


@pytest.fixture(scope='module')
def relay() -> ModuleType:
    path = Path(__file__).parents[1] / 'relay.py'
    spec = importlib.util.spec_from_file_location('relay', path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules['relay'] = module
    spec.loader.exec_module(module)
    return module


def test_loss_and_cut(relay: ModuleType) -> None:
    link = relay.Link(loss=0.05)
    chance = random.Random(1)
    lost = sum(link.schedule(100, 0.0, chance) is None for _ in range(10_000))
    assert 400 < lost < 600
    link.cut = True
    assert link.schedule(100, 0.0, chance) is None


def test_the_rate_queues_and_then_loses(relay: ModuleType) -> None:
    link = relay.Link(rate=10e6, queue=0.1)
    chance = random.Random(1)
    times = [link.schedule(1250 - 42, 0.0, chance) for _ in range(200)]
    arrived = [time for time in times if time is not None]
    # a millisecond each, and 100 ms of them wait
    assert arrived[:3] == pytest.approx([0.001, 0.002, 0.003])
    assert 100 <= len(arrived) <= 102
    assert link.schedule(1250 - 42, 1.0, chance) == pytest.approx(1.001)


def test_packets_pass_both_ways_and_a_rebind_moves_the_client(relay: ModuleType) -> None:
    async def run() -> tuple[list[bytes], set[int], dict[str, int]]:
        target, client = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
        try:
            for one in (target, client):
                one.bind(('127.0.0.1', 0))
                one.settimeout(60.0)
            link = relay.Relay(target.getsockname())
            address = await link.start(('127.0.0.1', 0))
            got, ports = [], set()
            for turn in range(2):
                client.sendto(b'%d' % turn, address)
                data, sender = await asyncio.to_thread(target.recvfrom, 100)
                ports.add(sender[1])
                assert (sender[0] == '127.0.0.2') == bool(turn)
                target.sendto(b're' + data, sender)
                got.append(await asyncio.to_thread(client.recv, 100))
                counters = link.change({'rebind': True} if turn else {'source': '127.0.0.2'})
            with pytest.raises(ValueError, match='nonsense'):
                link.change({'nonsense': 1})
            link.close()
            return got, ports, counters
        finally:
            target.close()
            client.close()

    got, ports, counters = loops.run(run())
    assert got == [b're0', b're1'] and len(ports) == 2
    assert counters['passed'] == 4 and counters['lost'] == 0
