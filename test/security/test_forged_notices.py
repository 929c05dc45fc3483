# SPDX-License-Identifier: Apache-2.0
"""A node on a machine reports that the provider reclaims the machine, which is not so."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
from pathlib import Path
import socket
import subprocess
import sys
from typing import Any

import pytest

from fogros2.agent_client import agent_program
from fogros2.errors import MachineNotFound
from fogros2.model import Machine, MachineState
from fogros2.provider.ssh import SSHProvider
from fogros2.waiting import wait_until

FORGED = ['echo', 'forged']


class Agent:
    """An agent as a process; its socket is open to each node of the machine."""

    def __init__(self, folder: Path, **config: Any) -> None:
        self.directory = folder / 'agent'
        program, path = folder / 'agent.py', folder / 'config.json'
        program.write_text(agent_program())
        path.write_text(json.dumps({
            'machine': 'planner', 'launch': 'abc123', 'directory': str(self.directory),
            'robot_timeout': 60, **config}))
        self.process = subprocess.Popen(
            [sys.executable, '-IS', str(program), 'serve', '--config', str(path)],
            stderr=subprocess.DEVNULL)
        wait_until(self._answers, timeout=60, what='the agent')

    def _answers(self) -> bool:
        with contextlib.suppress(OSError):
            return bool(self.ask('ping')['ok'])
        return False

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Return the agent's answer to a request."""
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(60)
            link.connect(str(self.directory / 'agent.sock'))
            link.sendall(json.dumps({'id': 1, 'command': command, **arguments}).encode() + b'\n')
            answer: dict[str, Any] = json.loads(link.makefile('rb').readline())
            return answer

    def notices(self) -> list[str]:
        """Return the reasons of all notices that the robot gets."""
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(60)
            link.connect(str(self.directory / 'agent.sock'))
            link.sendall(b'{"id": 1, "command": "log", "from": 1}\n')
            lines = link.makefile('rb')
            last = json.loads(lines.readline())['next']
            events = [json.loads(lines.readline()) for _ in range(last - 1)]
        return [event['reason'] for event in events if event['event'] == 'notice']


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Agent]]:
    made: list[Agent] = []

    def make(**config: Any) -> Agent:
        made.append(Agent(tmp_path, **config))
        return made[0]

    yield make
    made[0].process.terminate()
    made[0].process.wait(60)


@pytest.mark.parametrize('real', [[], ['false'], ['sh', '-c', 'echo real']])
def test_node_cannot_change_the_command_of_the_notice(
    serve: Callable[..., Agent], real: list[str],
) -> None:
    agent = serve()  # as a cloud starts it at boot, before the launch connects
    assert agent.ask('configure', launch='abc123', notice=real)['ok']
    for forged in (
            agent.ask('watch', what='notice', argv=FORGED),
            agent.ask('configure', notice=FORGED),
            agent.ask('configure', notice=FORGED, launch='abc123', again=True),
            agent.ask('configure', notice=None)):
        assert not forged['ok'], forged
    assert agent.ask('configure', launch='abc123', again=True)['ok']
    wanted = ['real'] if 'sh' in real else []
    wait_until(lambda: agent.notices() == wanted, timeout=60, what='the notice')
    assert agent.ask('status')['ok'] and agent.notices() == wanted


def test_next_launch_sets_its_own_command(serve: Callable[..., Agent]) -> None:
    agent = serve(notice=['false'])  # as a launch starts it
    assert agent.ask('configure', launch='def456', force='abc123', notice=['echo', 'new'])['ok']
    wait_until(lambda: agent.notices() == ['new'], timeout=60, what='the notice')


@pytest.mark.parametrize(('state', 'reclaims'), [
    (MachineState.PENDING, False), (MachineState.RUNNING, False), (MachineState.STOPPING, True),
    (MachineState.STOPPED, True), (MachineState.DELETED, True), (None, True)])
def test_provider_confirms_by_its_own_state(
    state: MachineState | None, reclaims: bool, monkeypatch: pytest.MonkeyPatch,
) -> None:
    def describe(self: object, machine: str) -> Machine:
        if state is None:
            raise MachineNotFound('it is gone')
        return Machine(machine, 'planner', 'ssh', state)

    monkeypatch.setattr(SSHProvider, 'describe', describe)
    assert SSHProvider().reclaims('1') == reclaims
