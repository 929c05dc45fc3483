# SPDX-License-Identifier: Apache-2.0
"""Agents of this computer as processes, their clients and events."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import json
import os
from pathlib import Path
import pwd
import signal
import socket
import subprocess
import sys
from typing import Any

from fogros2.agent_client import agent_program, AgentClient
from fogros2.model import Command, Endpoint, NodeSpec
from fogros2.shell import Stream
from fogros2.shell.local import LocalShell
from fogros2.waiting import wait_until

#: The launch that the agents are of, and a key that signs heartbeats.
LAUNCH, KEY = 'abc123', '5a' * 32


class CutShell(LocalShell):
    """Reaches the agent of this computer; ``cut`` loses the connection."""

    def __init__(self) -> None:
        super().__init__(Endpoint('local'), name='planner')
        self.streams: list[Any] = []

    def open(self, command: Command) -> Stream:
        self.streams.append(super().open(command))
        stream: Stream = self.streams[-1]
        return stream

    def cut(self) -> None:
        self.streams[-1]._channel.child.kill()

    def pause(self) -> None:
        """Let the connection carry nothing more, until its process gets SIGCONT."""
        self.streams[-1]._channel.child.send_signal(signal.SIGSTOP)


class Raw:
    """A connection without manners."""

    def __init__(self, directory: Path) -> None:
        self.link = socket.socket(socket.AF_UNIX)
        self.link.settimeout(60)
        try:
            self.link.connect(str(directory / 'agent.sock'))
        except OSError:
            self.link.close()
            raise
        self.lines = self.link.makefile('rb')

    def ask(self, data: bytes) -> dict[str, Any]:
        self.link.sendall(data)
        answer: dict[str, Any] = json.loads(self.lines.readline() or b'{}')
        return answer

    def close(self) -> None:
        self.lines.close()
        self.link.close()


class Rig:
    """An agent in a folder of its own, a client of it, and the events that came."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.folder = folder
        self.settings = settings
        self.program = folder / 'joined-agent.py'
        self.program.write_text(agent_program())
        self.directory = folder / 'agent'
        self.shell = CutShell()
        self.events: list[Any] = []
        #: The command line of a program that executes the agent.
        self.prefix: tuple[str, ...] = ()
        self.agents: list[subprocess.Popen[bytes]] = []
        self.clients: list[AgentClient] = []

    def words(self, *options: str, **config: Any) -> list[str]:
        """Return the command line of an agent."""
        path = self.folder / 'config.json'
        path.write_text(json.dumps({
            'machine': 'planner', 'launch': LAUNCH, 'directory': str(self.directory),
            'user': pwd.getpwuid(os.getuid()).pw_name, **self.settings, **config}))
        return [sys.executable, '-IS', str(self.program), 'serve', *options, '--config', str(path)]

    def serve(self, **config: Any) -> subprocess.Popen[bytes]:
        agent = subprocess.Popen([*self.prefix, *self.words(**config)], stderr=subprocess.PIPE)
        self.agents.append(agent)
        wait_until(lambda: self.ask('ping') or agent.poll() is not None, timeout=60,
                   what='the agent')
        return agent

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Return the agent's answer to a request on a connection of its own; {} without one."""
        with contextlib.suppress(OSError), contextlib.closing(Raw(self.directory)) as raw:
            return raw.ask(json.dumps({'id': 1, 'command': command, **arguments}).encode() + b'\n')
        return {}

    def client(self, *, follow: bool = True) -> AgentClient:
        client = AgentClient(self.shell, str(self.directory), agent_path=str(self.program))
        self.clients.append(client)
        if follow:
            client.subscribe(self.events.append, since=1)
        return client

    def started(self, **config: Any) -> AgentClient:
        """Start an agent; return a client that follows its events."""
        self.serve(**config)
        return self.client()

    def kill(self) -> None:
        self.agents[-1].kill()
        self.agents[-1].wait(60)

    def node(self, name: str, code: str, **more: Any) -> NodeSpec:
        path = self.folder / f'{name}.py'
        path.write_text(code)
        return NodeSpec(id=name, name=f'{name}-1', arguments=(sys.executable, str(path)), **more)

    def run(self, *nodes: NodeSpec) -> None:
        """Start nodes, and wait for the first line of each."""
        self.clients[-1].request('start', nodes=nodes)
        # Python writes the text of a line and its end apart
        wait_until(lambda: all('\n' in self.text(node.id) for node in nodes), timeout=60,
                   what=f'a line of each node in {self.events}', longest=0.02)

    def wait(self, event: str, timeout: float = 60, **match: Any) -> dict[str, Any]:
        def find() -> Any:
            for seen in list(self.events):
                if seen['event'] == event and all(seen.get(k) == v for k, v in match.items()):
                    return seen
            return None
        message: dict[str, Any] = wait_until(
            find, timeout=timeout, what=f'{event} {match} in {self.events}', interval=0.005,
            longest=0.02)
        return message

    def text(self, node: str, stream: str = 'stdout') -> str:
        return ''.join(e['text'] for e in list(self.events)
                       if e['event'] == 'output' and (e['node'], e['stream']) == (node, stream))

    def close(self) -> None:
        for client in self.clients:
            client.close()
        for agent in self.agents:
            if agent.poll() is None:
                agent.send_signal(signal.SIGTERM)
                agent.wait(60)
            assert agent.stderr is not None
            agent.stderr.close()


def gone(pid: int) -> Callable[[], bool]:
    """Return what tells whether a process has ended (a zombie has)."""
    def probe() -> bool:
        try:
            return b') Z ' in Path(f'/proc/{pid}/stat').read_bytes()
        except OSError:
            return True
    return probe
