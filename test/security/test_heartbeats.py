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
import subprocess
import sys
import time
from typing import Any, Optional

import pytest

from fogros2.agent.protocol import BEAT, sign
from fogros2.agent_client import agent_program, Heartbeat
from fogros2.waiting import wait_until

LAUNCH = 'abc123'
KEY, OTHER = '5a' * 32, 'a5' * 32
#: Seconds.
ROBOT_TIMEOUT = 3.0
NESTED = b'[' * 2000


class Machine:
    """An agent as a process, which marks the end of its machine with a file."""

    def __init__(self, folder: Path) -> None:
        self.directory = folder / 'agent'
        self.ended = folder / 'ended'
        self.program = folder / 'agent.py'
        self.program.write_text(agent_program())
        self.log = folder / 'log'
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(('127.0.0.1', 0))
            self.port = probe.getsockname()[1]
        self.attacker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.attacker.setblocking(False)
        self.agent: Optional[subprocess.Popen[bytes]] = None

    def serve(self) -> None:
        """Start the agent, or start it again."""
        config = self.directory.with_name('config.json')
        config.write_text(json.dumps({
            'machine': 'planner', 'launch': LAUNCH, 'directory': str(self.directory),
            'robot_timeout': ROBOT_TIMEOUT, 'end_command': ['touch', str(self.ended)]}))
        with self.log.open('ab') as log:
            self.agent = subprocess.Popen(
                [sys.executable, '-IS', str(self.program), 'serve', '--config', str(config)],
                stderr=log)
        wait_until(lambda: self.ask('ping') is not None, timeout=60, what='the agent')

    def ask(self, command: str, **arguments: Any) -> Optional[dict[str, Any]]:
        """Return the agent's answer to a request of the robot; None if no agent is there."""
        with socket.socket(socket.AF_UNIX) as link, contextlib.suppress(OSError):
            link.settimeout(60)
            link.connect(str(self.directory / 'agent.sock'))
            link.sendall(json.dumps({'id': 1, 'command': command, **arguments}).encode() + b'\n')
            answer: dict[str, Any] = json.loads(link.makefile('rb').readline())
            return answer
        return None

    def guard(self, key: str = KEY, **more: Any) -> None:
        """Let a launch configure the heartbeats."""
        answer = self.ask('configure', heartbeat={
            'bind': '127.0.0.1', 'port': self.port, 'peer': '127.0.0.1', 'key': key}, **more)
        assert answer is not None and answer['ok'], answer

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

    def kill(self) -> None:
        """Kill the agent."""
        assert self.agent is not None
        self.agent.kill()
        self.agent.wait(60)

    def close(self) -> None:
        self.attacker.close()
        self.kill()


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path)
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


def test_who_knows_the_launch_id_forges_no_heartbeat(machine: Machine) -> None:
    machine.guard()
    plain = json.dumps({'launch': LAUNCH, 'n': 1, 't': 1.0}).encode()
    machine.ends_although(
        plain, sign(OTHER, BEAT.pack(9, 1.0)), sign('', BEAT.pack(9, 1.0)),
        BEAT.pack(9, 1.0) + bytes(32))


def test_recorded_heartbeats_keep_no_machine(machine: Machine) -> None:
    machine.guard()
    machine.ends_although(*recorded(machine, 3))


def test_recorded_heartbeats_do_not_count_after_a_restart(machine: Machine) -> None:
    machine.guard()
    beats = recorded(machine, 3)
    machine.kill()
    machine.serve()
    machine.ends_although(*beats)


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


def test_released_machine_forgets_the_key(machine: Machine) -> None:
    machine.guard()
    assert KEY in (machine.directory / 'config.json').read_text()
    machine.ask('release', on_exit='keep')
    for path in machine.directory.iterdir():
        assert path.is_socket() or KEY not in path.read_text(), path


def test_files_with_the_key_are_private(machine: Machine) -> None:
    machine.guard()
    recorded(machine, 1)
    for name in ('config.json', 'watchdog.json'):
        assert (machine.directory / name).stat().st_mode & 0o777 == 0o600


def test_nonsense_is_dropped_without_an_answer(machine: Machine) -> None:
    machine.guard(robot_timeout=600.0)
    beat = sign(KEY, BEAT.pack(1, 1.0))
    made = random.Random(4)
    machine.attack(NESTED, b'', beat[:-1], beat + b'\0', beat * 5, b'\xff' * 256)
    for _ in range(3000):
        damaged = bytearray(beat)
        damaged[made.randrange(len(beat))] ^= 1 << made.randrange(8)
        machine.attack(made.randbytes(made.randrange(300)), bytes(damaged))
        if made.random() < 0.05:  # the socket's buffer holds a few hundred
            assert machine.ask('ping') is not None
    assert not machine.answers()

    def answered() -> bool:
        machine.attack(beat)  # again and again: the nonsense may still fill the socket's buffer
        return len(machine.answers()) == 1

    wait_until(answered, timeout=60, what='the answer to the robot')




def test_robot_takes_no_answer_of_a_stranger() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(('127.0.0.1', 0))
        stranger.settimeout(60)
        with contextlib.closing(Heartbeat(
                '127.0.0.1', stranger.getsockname()[1], KEY, interval=0.05)) as robot:
            for _ in range(5):
                beat, sender = stranger.recvfrom(2048)
                number, sent = BEAT.unpack(beat[:BEAT.size])
                for forged in (
                        beat, json.dumps({'launch': LAUNCH, 't': sent}).encode(), NESTED,
                        sign(OTHER, BEAT.pack(number, sent) + bytes(8))):
                    stranger.sendto(forged, sender)
            assert robot.round_trip is None and robot.age is None
