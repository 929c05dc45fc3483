# SPDX-License-Identifier: Apache-2.0
"""The agent as a process, its nodes as real processes below launch, the client over a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import pwd
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import Any, Optional

from fogros2.agent_client import agent_source, AgentClient, cloud_launch_source, Heartbeat
from fogros2.errors import AgentError, ConnectError
from fogros2.model import Command, NodeSpec
from fogros2.waiting import wait_until
import pytest

pytest.importorskip('launch.actions', reason='needs ROS 2, or its embedded default')

ME = pwd.getpwuid(os.getuid()).pw_name
#: What a sourced ROS 2 needs; an agent that runs as root gives nodes a login's environment.
ROS_VARIABLES = ('PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH')
LAUNCH = [sys.executable, str(cloud_launch_source())]


class PipeStream:
    """A program here in the place of one on a machine."""

    def __init__(self, command: Command) -> None:
        self.child = subprocess.Popen(
            command.argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)

    def write(self, data: bytes) -> None:
        assert self.child.stdin is not None
        try:
            while data:
                data = data[self.child.stdin.write(data):]
        except (OSError, ValueError) as error:
            raise ConnectError('the pipe is gone') from error

    def readline(self) -> bytes:
        assert self.child.stdout is not None
        try:
            return self._lines.readline()
        except ValueError:
            return b''

    @property
    def _lines(self) -> Any:
        if not hasattr(self, '_buffered'):
            import io
            self._buffered = io.BufferedReader(self.child.stdout)  # type: ignore[arg-type]
        return self._buffered

    def close(self) -> None:
        self.child.kill()
        self.child.wait()


class PipeShell:
    """The part of a Shell that the client uses; ``cut`` loses the link, ``down`` keeps it so."""

    def __init__(self) -> None:
        self.streams: list[PipeStream] = []
        self.down = False

    def open(self, command: Command) -> PipeStream:
        if self.down:
            raise ConnectError('no route')
        self.streams.append(PipeStream(command))
        return self.streams[-1]

    def cut(self) -> None:
        self.streams[-1].child.kill()

    def close(self) -> None:
        for stream in self.streams:
            stream.close()
            stream.child.stdin.close()  # type: ignore[union-attr]
            stream._lines.close()


class Rig:
    """An agent in a folder of its own, a client of it, and the events that came."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.directory = folder / 'agent'
        self.home = folder
        self.shell = PipeShell()
        self.events: list[dict[str, Any]] = []
        self.agents: list[subprocess.Popen[bytes]] = []
        self.clients: list[AgentClient] = []

    def config(self, **more: Any) -> Path:
        config = {
            'machine': 'planner', 'launch': 'abc123', 'directory': str(self.directory),
            'user': ME, 'ros_command': LAUNCH, 'environment': {
                'ROS_LOG_DIR': str(self.folder),
                **{key: os.environ[key] for key in ROS_VARIABLES if key in os.environ}},
            **more}
        path = self.folder / 'config.json'
        path.write_text(json.dumps(config))
        return path

    def serve(self, **config: Any) -> subprocess.Popen[bytes]:
        agent = subprocess.Popen(
            [sys.executable, '-IS', str(agent_source()), 'serve', '--config',
             str(self.config(**config))], stderr=subprocess.PIPE)
        self.agents.append(agent)
        wait_until(lambda: self.can_connect() or agent.poll() is not None, timeout=10,
                   what='the agent')
        return agent

    def can_connect(self) -> bool:
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.connect(str(self.directory / 'agent.sock'))
            return True
        return False

    def client(self, *, follow: bool = True, **more: Any) -> AgentClient:
        client = AgentClient(
            self.shell, str(self.directory),  # type: ignore[arg-type]
            python=sys.executable, agent_path=str(agent_source()), **more)
        self.clients.append(client)
        if follow:
            client.subscribe(self.events.append, since=1)
        return client

    def node(self, name: str, code: str, **more: Any) -> NodeSpec:
        path = self.folder / f'{name}.py'
        path.write_text(code)
        return NodeSpec(id=name, name=f'{name}-1', arguments=(sys.executable, str(path)), **more)

    def wait(self, event: str, timeout: float = 20, **match: Any) -> dict[str, Any]:
        def find() -> Optional[dict[str, Any]]:
            for seen in list(self.events):
                if seen['event'] == event and all(seen.get(k) == v for k, v in match.items()):
                    return seen
            return None
        return wait_until(find, timeout=timeout, what=f'{event} {match} in {self.events}',
                          interval=0.005, longest=0.02)

    def text(self, node: str, stream: str = 'stdout') -> str:
        return ''.join(e['text'] for e in list(self.events)
                       if e['event'] == 'output' and (e['node'], e['stream']) == (node, stream))

    def ended(self, agent: subprocess.Popen[bytes], timeout: float = 15) -> int:
        return agent.wait(timeout)

    def close(self) -> None:
        for client in self.clients:
            client.close()
        for agent in self.agents:
            if agent.poll() is None:
                agent.send_signal(signal.SIGTERM)
                agent.wait(10)
            assert agent.stderr is not None
            agent.stderr.close()
        self.shell.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def gone(pid: int) -> Callable[[], bool]:
    """Return what tells whether a process has ended (a zombie has)."""
    def probe() -> bool:
        try:
            return b') Z ' in Path(f'/proc/{pid}/stat').read_bytes()
        except OSError:
            return True
    return probe


SLEEP = 'import time\nprint("up")\ntime.sleep(600)\n'


def test_a_node_runs_and_its_output_and_exit_status_arrive(rig):
    rig.serve()
    client = rig.client()
    client.request('launch')
    client.request('start', nodes=[rig.node('n', (
        'import os, sys\n'
        'print("hello", os.environ["X"], os.getcwd())\n'
        'print("oops", file=sys.stderr)\n'
        'sys.exit(7)\n'), environment={'X': 'there'}, cwd=str(rig.folder))])
    started = rig.wait('started', node='n')
    assert rig.wait('exited', node='n')['returncode'] == 7
    assert rig.text('n') == f'hello there {rig.folder}\n'
    assert rig.text('n', 'stderr') == 'oops\n'
    assert started['pid'] > 0 and started['name'] == 'n-1'
    status = client.request('status')
    assert status['nodes'] == [{
        'id': 'n', 'name': 'n-1', 'state': 'exited', 'pid': None, 'returncode': 7,
        'restarts': 0}]
    assert status['rss_kb'] < 30_000
    assert [e['seq'] for e in rig.events] == list(range(1, len(rig.events) + 1))
