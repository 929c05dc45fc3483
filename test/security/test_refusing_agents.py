# SPDX-License-Identifier: Apache-2.0
"""An agent that refuses or says nothing ends the nodes of its machine, and not the launch."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
import json
import queue
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('launch.actions', reason='needs ROS 2, or its embedded default')

from fogros2.agent_client import AgentClient
from fogros2.errors import AgentError, ConnectError, DeadlineExceeded, FogError, PrerequisiteError
from fogros2.model import MachineSpec, NodeSpec
from fogros2.runtime.run_state import RunState
from fogros2.runtime.session import Session
from fogros2.waiting import wait_until

NODE = NodeSpec('1', 'talker-1', 'demo', 'talker')


class Run:
    """A process as a session has it."""

    node = NODE

    def __init__(self, started: bool) -> None:
        self.state = RunState(True, 'running' if started else 'waiting')
        self.events: list[dict[str, Any]] = []
        self.ended = False

    def on_event(self, event: dict[str, Any]) -> None:
        self.events.append(event)

    def on(self, event: str) -> None:
        self.ended = event == 'over'


class Launch:
    """A launch's event loop with one machine; ``failures`` are the errors that end the launch."""

    def __init__(self, run: Run, start: Callable[..., object]) -> None:
        self.failures: list[BaseException] = []
        self.loop = asyncio.new_event_loop()
        running: Any = SimpleNamespace(start=start, subscribe=lambda callback: None)
        self.session = Session(
            MachineSpec('planner', 'container'), self.loop, in_thread=self.in_thread,
            fail=self.failures.append, changed=lambda: None, preempted=lambda *_: None)
        self.session.submit(run)  # type: ignore[arg-type]
        self.session.up(running)
        self.loop.run_until_complete(self.settled())

    def in_thread(self, function: Callable[..., Any], *words: Any) -> asyncio.Future[Any]:
        return self.loop.run_in_executor(None, function, *words)

    async def settled(self) -> None:
        while self.session.requests:
            await asyncio.gather(*self.session.requests, return_exceptions=True)


def raising(error: FogError) -> Callable[..., object]:
    def start(nodes: object) -> None:
        raise error
    return start


@pytest.mark.parametrize('error', [
    AgentError('no', 'never'), ConnectError('it is lost', 'never'),
    DeadlineExceeded("the agent didn't answer 'start'", 'never')])
def test_refused_start_does_not_end_the_launch(error: FogError) -> None:
    run = Run(started=False)
    launch = Launch(run, raising(error))
    assert launch.failures == []
    assert [(event['event'], event['error'], event['hint']) for event in run.events] == [
        ('refused', error.args[0], 'never')]


def test_missing_package_still_ends_the_launch() -> None:
    """The user has to add it: no machine says this."""
    run = Run(started=False)
    error = PrerequisiteError('the machine lacks numpy', 'pip=[...]')
    assert Launch(run, raising(error)).failures == [error] and run.ended


class Refusing:
    """An agent that refuses to say where its log begins."""

    def __init__(self) -> None:
        self.lines = queue.Queue[bytes]()

    def open(self, command: object) -> Refusing:
        return self

    def write(self, data: bytes) -> None:
        for line in data.splitlines():
            request = json.loads(line)
            self.lines.put(json.dumps({
                'id': request['id'], 'ok': False, 'error': 'no', 'hint': ''}).encode() + b'\n')

    def readline(self) -> bytes:
        return self.lines.get()

    def close(self) -> None:
        self.lines.put(b'')


def test_refused_log_does_not_end_the_launch() -> None:
    events: list[Any] = []
    shell: Any = Refusing()
    client = AgentClient(shell, '/run/x', agent_path='/run/x/agent.py')
    try:
        client.subscribe(events.append, since=1)
        wait_until(lambda: bool(events), timeout=60, what='the end of the agent')
    finally:
        client.close()
    assert [(event['event'], event['state']) for event in events] == [('connection', 'absent')]
    run = Run(started=True)
    launch = Launch(run, lambda nodes: None)
    launch.session._on_event(events[0])
    assert launch.failures == [] and [event['event'] for event in run.events] == ['exited']
