# SPDX-License-Identifier: Apache-2.0
"""
Attack the agent's heartbeats from another account of the machine, which can use any address of it.

The attacker knows the launch's id, which is in the name of the VPN interface, and has recorded
heartbeats of the past. The agent's key is the only thing that the attacker does not have.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import json
from pathlib import Path
import random
import socket
import time
from typing import Any

import pytest

from fogros2.agent.protocol import BEAT, sign
from fogros2.waiting import wait_until
from rigs.agents import KEY, LAUNCH, Rig

OTHER = 'a5' * 32
NESTED = b'[' * 2000


class Machine(Rig):
    """An agent, which marks the end of its machine with a file; and an attacker."""

    def __init__(self, folder: Path, port: int) -> None:
        self.ended = folder / 'ended'
        super().__init__(folder, robot_timeout=3.0, end_command=['touch', str(self.ended)])
        self.port = port
        self.attacker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.attacker.setblocking(False)

    def guard(self, key: str = KEY, **more: Any) -> None:
        """Let a launch configure the heartbeats."""
        answer = self.ask('configure', heartbeat={
            'bind': '127.0.0.1', 'port': self.port, 'peer': '127.0.0.1', 'key': key}, **more)
        assert answer['ok'], answer

    def attack(self, *datagrams: bytes) -> None:
        """Send datagrams as another account of the machine."""
        for datagram in datagrams:
            self.attacker.sendto(datagram, ('127.0.0.1', self.port))

    def answers(self) -> list[bytes]:
        """Return what the attacker got."""
        found = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self.attacker.recv(2048))
        return found

    def ends_although(self, *datagrams: bytes) -> None:
        """Check that the machine ends while the attacker sends."""
        def over() -> bool:
            self.attack(*datagrams)
            return self.ended.exists()

        wait_until(over, timeout=60, what='the end of the machine in spite of forged heartbeats',
                   interval=0.05, longest=0.1)
        assert not self.answers()

    def close(self) -> None:
        self.attacker.close()
        super().close()


@pytest.fixture
def machine(tmp_path: Path, free_udp_port: int) -> Iterator[Machine]:
    machine = Machine(tmp_path, free_udp_port)
    machine.serve()
    with contextlib.closing(machine):
        yield machine


def recorded(machine: Machine, count: int, key: str = KEY) -> list[bytes]:
    """Return heartbeats as the robot sends them, and let the agent get the same ones."""
    beats = [sign(key, BEAT.pack(number, 7.0)) for number in range(1, count + 1)]
    for number, beat in enumerate(beats, 1):
        machine.attack(beat)
        wait_until(lambda number=number: len(machine.answers()) == 1, timeout=60, what='an answer')
    return beats


@pytest.mark.parametrize('restarted', [False, True])
def test_forged_and_recorded_heartbeats_keep_no_machine(machine: Machine, restarted: bool) -> None:
    machine.guard()
    beats = recorded(machine, 3)
    if restarted:
        machine.kill()
        machine.serve()
    plain = json.dumps({'launch': LAUNCH, 'n': 1, 't': 1.0}).encode()
    machine.ends_although(
        *beats, plain, sign(OTHER, BEAT.pack(9, 1.0)), sign('', BEAT.pack(9, 1.0)),
        BEAT.pack(9, 1.0) + bytes(32))


def test_killing_the_agent_again_and_again_keeps_no_machine(machine: Machine) -> None:
    machine.guard()
    begin = time.monotonic()
    while time.monotonic() - begin < 60 and not machine.ended.exists():
        machine.kill()
        machine.serve()
    assert machine.ended.exists(), 'a restarted agent begins a new deadline'


def test_next_launch_gets_a_new_key(machine: Machine) -> None:
    machine.guard()
    recorded(machine, 2)
    machine.guard(OTHER, launch='def456', force=LAUNCH)
    recorded(machine, 1, OTHER)
    machine.ends_although(*(sign(KEY, BEAT.pack(number, 1.0)) for number in range(1, 9)))


def test_key_is_private_and_forgotten_by_the_release(machine: Machine) -> None:
    machine.guard()
    recorded(machine, 1)
    assert KEY in (machine.directory / 'config.json').read_text()
    for name in ('config.json', 'watchdog.json'):
        assert (machine.directory / name).stat().st_mode & 0o777 == 0o600
    machine.ask('release', on_exit='keep')
    for path in machine.directory.iterdir():
        assert path.is_socket() or KEY not in path.read_text(), path


def test_nonsense_is_dropped_without_an_answer(machine: Machine) -> None:
    machine.guard(robot_timeout=600.0)
    beat = sign(KEY, BEAT.pack(1, 1.0))
    made = random.Random(4)
    machine.attack(NESTED, b'', beat[:-1], beat + b'\0', beat * 5, b'\xff' * 256)
    for _ in range(1000):
        damaged = bytearray(beat)
        damaged[made.randrange(len(beat))] ^= 1 << made.randrange(8)
        machine.attack(made.randbytes(made.randrange(300)), bytes(damaged))
        if made.random() < 0.05:  # the socket's buffer holds a few hundred
            assert machine.ask('ping')
    assert not machine.answers()

    def answered() -> bool:
        machine.attack(beat)  # again and again: the nonsense may still fill the socket's buffer
        return len(machine.answers()) == 1

    wait_until(answered, timeout=60, what='the answer to the robot')

