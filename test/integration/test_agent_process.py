# SPDX-License-Identifier: Apache-2.0
"""The agent as a process, its nodes as real processes, the client over a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import io
import json
import os
from pathlib import Path
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, Optional

import pytest

from fogros2.agent.processes import SWEEP
from fogros2.agent_client import agent_program, AgentClient, Heartbeat
from fogros2.errors import AgentError, ConnectError
from fogros2.model import Command, NodeSpec
from fogros2.waiting import wait_until

ME = pwd.getpwuid(os.getuid()).pw_name
#: What a sourced ROS 2 needs; an agent that runs as root gives nodes a login's environment.
ROS_VARIABLES = ('PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH')
#: Signs the heartbeats.
KEY = '5a' * 32


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


def program(folder: Path) -> Path:
    """Write the agent's program into a folder."""
    path = folder / 'joined-agent.py'
    path.write_text(agent_program())
    return path


class Rig:
    """An agent in a folder of its own, a client of it, and the events that came."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.program = program(folder)
        self.directory = folder / 'agent'
        self.prefix = folder / 'prefix'
        (self.prefix / 'share/ament_index/resource_index/packages').mkdir(parents=True)
        (self.prefix / 'share/ament_index/resource_index/packages/pack').touch()
        self.shell = PipeShell()
        self.events: list[dict[str, Any]] = []
        self.agents: list[subprocess.Popen[bytes]] = []
        self.clients: list[AgentClient] = []

    def config(self, **more: Any) -> Path:
        config = {
            'machine': 'planner', 'launch': 'abc123', 'directory': str(self.directory),
            'user': ME, 'environment': {
                **{key: os.environ[key] for key in ROS_VARIABLES if key in os.environ},
                'AMENT_PREFIX_PATH': str(self.prefix)},
            **more}
        path = self.folder / 'config.json'
        path.write_text(json.dumps(config))
        return path

    def serve(
        self, program: Optional[Path] = None, **config: Any,
    ) -> subprocess.Popen[bytes]:
        agent = subprocess.Popen(
            [sys.executable, '-IS', str(program or self.program), 'serve', '--config',
             str(self.config(**config))], stderr=subprocess.PIPE)
        self.agents.append(agent)
        wait_until(lambda: self.can_connect() or agent.poll() is not None, timeout=60,
                   what='the agent')
        return agent

    def can_connect(self) -> bool:
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.connect(str(self.directory / 'agent.sock'))
            return True
        return False

    def client(self, *, follow: bool = True) -> AgentClient:
        client = AgentClient(
            self.shell, str(self.directory),  # type: ignore[arg-type]
            agent_path=str(self.program))
        self.clients.append(client)
        if follow:
            client.subscribe(self.events.append, since=1)
        return client

    def node(self, name: str, code: str, **more: Any) -> NodeSpec:
        path = self.folder / f'{name}.py'
        path.write_text(code)
        return NodeSpec(id=name, name=f'{name}-1', arguments=(sys.executable, str(path)), **more)

    def wait(self, event: str, timeout: float = 60, **match: Any) -> dict[str, Any]:
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

    def ended(self, agent: subprocess.Popen[bytes], timeout: float = 60) -> int:
        return agent.wait(timeout)

    def close(self) -> None:
        for client in self.clients:
            client.close()
        for agent in self.agents:
            if agent.poll() is None:
                agent.send_signal(signal.SIGTERM)
                agent.wait(60)
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


def test_output_and_exit_status_of_a_node_arrive(rig):
    rig.serve()
    client = rig.client()
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


def test_signals_and_negative_exit_statuses(rig):
    rig.serve()
    client = rig.client()
    client.request('start', nodes=[
        rig.node('asked', (
            'import signal, sys, time\n'
            'signal.signal(signal.SIGUSR1, lambda *_: sys.exit(42))\n'
            'print("up")\ntime.sleep(600)\n')),
        rig.node('killed', SLEEP)])
    for name in ('asked', 'killed'):
        rig.wait('output', node=name)
    client.request('signal', node='asked', signal='SIGUSR1')
    client.request('signal', node='killed', signal='SIGKILL')
    assert rig.wait('exited', node='asked')['returncode'] == 42
    assert rig.wait('exited', node='killed')['returncode'] == -9
    with pytest.raises(AgentError, match="isn't running"):
        client.request('signal', node='killed', signal='SIGINT')
    with pytest.raises(AgentError, match="no signal 'SIGNONSENSE'"):
        client.request('signal', node='killed', signal='SIGNONSENSE')


def test_nodes_start_as_their_specs_say(rig):
    """A program that cannot be executed harms no other, and a second request starts nothing."""
    rig.serve()
    client = rig.client()
    (rig.folder / 'broken').write_bytes(b'\x7fELFnot')
    (rig.folder / 'broken').chmod(0o700)
    nodes = [
        NodeSpec('cat', 'c-1', arguments=('cat',)),
        NodeSpec('broken', 'b-1', arguments=(str(rig.folder / 'broken'),)),
        NodeSpec('shell', 's-1', shell=True,  # noqa: S604 (a constant)
                 arguments=('echo one two | tr a-z', 'A-Z')),
        NodeSpec('tty', 't-1', arguments=('test', '-t', '1'), emulate_tty=True),
        NodeSpec('prefix', 'p-1', arguments=('echo', 'hi'), prefix=('env', 'X=1')),
        rig.node('binary', (
            'import os, time\n'
            'os.write(1, b"\\xff\\xfe\\x00ok \\xc3")\n'
            'time.sleep(0.1)\n'  # splits a character in two
            'os.write(1, b"\\xa9 no newline \\xe2\\x82")\n'))]
    assert client.request('start', nodes=nodes)['known'] == []
    assert client.request('start', nodes=nodes)['known'] == [node.id for node in nodes]
    for node in ('shell', 'tty', 'prefix', 'binary'):
        assert rig.wait('exited', node=node)['returncode'] == 0
    assert (rig.text('shell'), rig.text('prefix')) == ('ONE TWO\n', 'hi\n')
    assert rig.text('binary') == '\ufffd\ufffd\ufffdok \u00e9 no newline \ufffd'
    assert 'could not be executed' in rig.wait('refused', node='broken')['error']
    # its input has no end
    states = {node['id']: node['state'] for node in client.request('status')['nodes']}
    assert (states['cat'], states['broken']) == ('running', 'refused')
    assert [e['event'] for e in rig.events].count('started') == 5


def test_nodes_respawn_as_their_specs_say(rig):
    rig.serve()
    client = rig.client()
    client.request('start', nodes=[
        rig.node('fails', 'raise SystemExit(1)\n', respawn=True, respawn_max_retries=2),
        rig.node('killed', SLEEP, respawn=True, respawn_delay=0.2),
        rig.node('stopped', 'raise SystemExit(3)\n', respawn=True, respawn_delay=0.3)])
    rig.wait('exited', node='stopped', respawns=True)
    client.request('stop', nodes=['stopped'])
    before = client.request('status')['nodes'][2]
    first = rig.wait('started', node='killed')['pid']
    os.kill(first, signal.SIGKILL)
    exited = rig.wait('exited', node='killed', returncode=-9, respawns=True)
    second = wait_until(lambda: next((
        e for e in list(rig.events) if e['event'] == 'started' and e['node'] == 'killed'
        and e['pid'] != first), None), timeout=60, what='the second start')
    assert second['time'] - exited['time'] >= 0.2
    rig.wait('exited', node='fails', respawns=False)
    assert [e['respawns'] for e in rig.events
            if e['event'] == 'exited' and e['node'] == 'fails'] == [True, True, False]
    client.request('start', nodes=[rig.node('later', 'import time\ntime.sleep(0.6)\n')])
    rig.wait('exited', node='later')
    fails, _, stopped, _ = client.request('status')['nodes']
    assert fails['restarts'] == 2
    assert (stopped['state'], stopped['pid']) == ('exited', None)
    assert stopped['restarts'] == before['restarts']


def test_stop_goes_from_sigint_to_sigkill(rig):
    rig.serve()
    client = rig.client()
    stubborn = (
        'import signal, time\n'
        'for number in (signal.SIGINT, signal.SIGTERM):\n'
        '    signal.signal(number, lambda n, _: print("not", n))\n'
        'print("up")\n'
        'while True:\n'
        '    time.sleep(0.05)\n')
    client.request('start', nodes=[
        rig.node('stubborn', stubborn, sigterm_timeout=0.2, sigkill_timeout=0.2, respawn=True),
        rig.node('polite', SLEEP)])
    for name in ('stubborn', 'polite'):
        rig.wait('output', node=name)
    client.request('stop', nodes=['stubborn'])
    exited = rig.wait('exited', node='stubborn')
    assert (exited['returncode'], exited['respawns']) == (-9, False)
    assert 'not 2\n' in rig.text('stubborn') and 'not 15\n' in rig.text('stubborn')
    states = {n['id']: n['state'] for n in client.request('status')['nodes']}
    assert states == {'stubborn': 'exited', 'polite': 'running'}
    client.request('stop', nodes=None)
    assert rig.wait('exited', node='polite')['returncode'] == -2


def test_much_output_fills_neither_memory_nor_disk(rig):
    agent = rig.serve(log_bytes=2 << 20)
    client = rig.client(follow=False)
    client.request('start', nodes=[rig.node('n', (
        'import sys\n'
        'block = b"x" * 99 + b"\\n"\n'
        'for _ in range(3000):\n'
        '    sys.stdout.buffer.write(block * 100)\n'))])  # 30 MB
    def state():
        return client.request('status')['nodes'][0]['state'] == 'exited'
    wait_until(state, timeout=60, what='the node')
    assert client.request('status')['rss_kb'] < 30_000
    sizes = [path.stat().st_size for path in rig.directory.glob('events*.jsonl')]
    assert len(sizes) == 2 and sum(sizes) < 5 << 20
    status = client.request('status')
    assert status['first'] > 1
    client.subscribe(rig.events.append, since=1)
    rig.wait('exited', node='n')
    assert rig.events[0] == {'event': 'gap', 'count': status['first'] - 1}
    assert [e['seq'] for e in rig.events[1:]] == list(range(status['first'], status['next']))
    assert agent.poll() is None


def test_lost_connection_loses_and_repeats_no_event(rig):
    rig.serve()
    client = rig.client()
    client.request('start', nodes=[rig.node('n', (
        'import time\n'
        'for n in range(150):\n'
        '    print(n)\n'
        '    time.sleep(0.01)\n'))])

    def connections() -> list[str]:
        return [e['state'] for e in list(rig.events) if e['event'] == 'connection']

    for number, count in enumerate((20, 60, 100), 1):
        wait_until(lambda count=count: len(rig.text('n').split()) > count, timeout=60,
                   what='lines', longest=0.02)
        rig.shell.cut()
        # lines of the lost connection may count for the next cut
        wait_until(lambda number=number: connections().count('back') == number, timeout=60,
                   what='the connection', longest=0.02)
    rig.wait('exited', node='n')
    assert rig.text('n').split() == [str(n) for n in range(150)]
    seqs = [e['seq'] for e in rig.events if 'seq' in e]
    assert seqs == list(range(1, len(seqs) + 1))
    assert connections() == 3 * ['lost', 'back']


class Raw:
    """A connection without manners."""

    def __init__(self, rig: Rig) -> None:
        self.link = socket.socket(socket.AF_UNIX)
        self.link.settimeout(60)
        self.link.connect(str(rig.directory / 'agent.sock'))
        self.lines = self.link.makefile('rb')

    def ask(self, data: bytes) -> dict[str, Any]:
        self.link.sendall(data)
        answer: dict[str, Any] = json.loads(self.lines.readline())
        return answer

    def close(self) -> None:
        self.lines.close()
        self.link.close()


BAD_REQUESTS = [
    (b'nonsense\n', 'malformed request'),
    (b'[1]\n', 'a request is a JSON object'),
    (b'{}\n', 'no such command: null'),
    (b'{"command": "fly"}\n', 'no such command: "fly"'),
    (b'{"command": {"x": 1}}\n', 'no such command'),
    (b'\xff\xfe\n', 'malformed request'),
    (b'[' * 100_000 + b'\n', 'malformed request'),
    (b'{"command": "start"}\n', "'nodes' is missing"),
    (b'{"command": "start", "nodes": 7}\n', "'nodes' is a list"),
    (b'{"command": "start", "nodes": [{"id": 1}]}\n', "has an 'id' and a 'name'"),
    (b'{"command": "stop", "nodes": ["x"]}\n', "no node 'x'"),
    (b'{"command": "configure", "lifetime": -1}\n', "'lifetime' has to be above 0"),
    (b'{"command": "configure", "environment": {"A=B": "x"}}\n', "can't set"),
    (b'{"command": "watch", "what": "x", "argv": "ls"}\n', 'no list of words'),
    (b'{"command": "log", "from": "x"}\n', 'malformed request'),
]


def test_invalid_requests_are_refused_and_connection_stays(rig):
    agent = rig.serve()
    raw = Raw(rig)
    for line, answer in BAD_REQUESTS:
        reply = raw.ask(line)
        assert reply['ok'] is False and answer in reply['error'], line
        assert raw.ask(b'{"id": 5, "command": "ping"}\n') == {'id': 5, 'ok': True}
    # one that is too long ends its connection
    with contextlib.suppress(BrokenPipeError):
        for _ in range(17):
            raw.link.sendall(b'x' * (1 << 20))
    assert 'longer than' in json.loads(raw.lines.readline())['error']
    with contextlib.suppress(ConnectionResetError):
        assert raw.lines.readline() == b''
    raw.close()
    assert agent.poll() is None


def test_lost_and_silent_clients_harm_no_other(rig):
    rig.serve(log_bytes=1 << 20)
    silent = Raw(rig)
    silent.ask(b'{"id": 1, "command": "log", "follow": true}\n')
    for data in (b'{"id": 1, "comm', b'', b'{"id": 1, "command": "status"}\n' * 50):
        raw = Raw(rig)
        raw.link.sendall(data)
        raw.close()
    crowd = [Raw(rig) for _ in range(100)]  # beyond what is kept open
    assert crowd[-1].ask(b'{"id": 1, "command": "status"}\n')['ok']
    for raw in crowd:
        raw.close()
    client = rig.client()
    client.request('start', nodes=[rig.node('n', 'for _ in range(30000): print("x" * 99)\n')])
    assert rig.wait('exited', node='n')['returncode'] == 0
    assert client.request('status')['rss_kb'] < 30_000
    silent.close()


def test_requests_are_answered_after_the_end_of_input(rig):
    def connect() -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            [sys.executable, '-IS', str(rig.program), 'connect', '--directory',
             str(rig.directory)],
            input=b'{"id": 9, "command": "log", "from": 1}\n{"id": 8, "command": "status"}\n',
            capture_output=True, timeout=60)

    absent = connect()
    assert (absent.returncode, json.loads(absent.stdout)['kind']) == (3, 'absent')
    rig.serve()
    done = connect()
    assert [json.loads(line)['id'] for line in done.stdout.splitlines()] == [9, 8]
    assert done.returncode == 0


def test_second_agent_is_refused_and_stale_socket_replaced(rig):
    first = rig.serve()
    second = rig.serve()
    assert second.wait(60) == 1
    assert second.stderr is not None
    line = second.stderr.read().decode()
    assert f'another agent (process {first.pid}) serves' in line and line.count('\n') == 1
    first.kill()
    first.wait(60)
    assert (rig.directory / 'agent.sock').exists()
    third = rig.serve()
    assert rig.client().request('status')['pid'] == third.pid


@pytest.mark.parametrize('config, reason', [
    ({'directory': '/proc/nothing/here'}, "can't be used"),
    ({'directory': '/'}, "can't have the directory '/'"),
    ({'user': 'nobody-of-that-name'}, "no user 'nobody-of-that-name'"),
    (None, "can't be read"),
])
def test_invalid_configuration_is_reported_in_one_line(rig, config, reason):
    path = rig.config(**config or {})
    if config is None:
        path.write_text('{')
    done = subprocess.run(
        [sys.executable, '-IS', str(rig.program), 'serve', '--config', str(path)],
        capture_output=True, timeout=60, cwd=rig.folder)
    assert done.returncode == 1
    assert reason in done.stderr.decode() and done.stderr.count(b'\n') == 1
    detached = subprocess.run(
        [sys.executable, '-IS', str(rig.program), 'serve', '--detach', '--config', str(path)],
        capture_output=True, timeout=60, cwd=rig.folder)
    assert detached.returncode == 1
    assert reason in json.loads(detached.stdout)['error']


def test_detached_agent_reports_when_it_is_ready(rig):
    done = subprocess.run(
        [sys.executable, '-IS', str(rig.program), 'serve', '--detach', '--config',
         str(rig.config())], capture_output=True, timeout=60)
    ready = json.loads(done.stdout)
    assert ready['ready'] is True and ready['socket'] == str(rig.directory / 'agent.sock')
    client = rig.client()
    assert client.request('status')['pid'] == ready['pid']
    client.request('release', exit=True)
    wait_until(gone(ready['pid']), timeout=60, what='the agent to leave')
    assert not rig.directory.exists()


def test_stopped_nodes_leave_no_descendant(rig):
    rig.serve(on_exit='keep')
    client = rig.client()
    client.request('start', nodes=[rig.node('n', (
        'import subprocess, time\n'
        'child = subprocess.Popen(["sleep", "600"], start_new_session=True)\n'
        'print(child.pid)\n'
        'time.sleep(600)\n'))])
    wait_until(lambda: '\n' in rig.text('n'), timeout=60, what='the child')
    client.request('release', on_exit='keep')
    assert gone(int(rig.text('n')))()


def test_setup_files_are_sourced(rig):
    setup = rig.folder / "it's a setup.bash"
    setup.write_text('echo printed\nexport SOURCED="from ${BASH_SOURCE[0]##*/} $# $LISTED"\n')
    rig.serve(setup=[str(setup)], environment={
        'LISTED': 'configured',
        **{key: os.environ[key] for key in ROS_VARIABLES if key in os.environ}})
    client = rig.client()
    client.request('start', nodes=[rig.node('n', 'import os\nprint(os.environ["SOURCED"])\n')])
    rig.wait('exited', node='n')
    assert rig.text('n') == "from it's a setup.bash 0 configured\n"
    client.request('configure', environment={'LISTED': 'later', 'PATH': os.environ['PATH']})
    client.request('start', nodes=[rig.node('m', 'import os\nprint(os.environ["SOURCED"])\n')])
    rig.wait('exited', node='m')
    assert rig.text('m') == "from it's a setup.bash 0 later\n"
    client.request('configure', setup=['/no/such/setup.bash'])
    with pytest.raises(AgentError, match='setup.bash to be sourced is not there'):
        client.request('start', nodes=[rig.node('later', SLEEP)])
    setup.write_text('exit 3\n')
    client.request('configure', setup=[str(setup)], environment={'PATH': os.environ['PATH']})
    with pytest.raises(AgentError, match="can't be sourced: exit status 3"):
        client.request('start', nodes=[rig.node('later', SLEEP)])
    assert [node['id'] for node in client.request('status')['nodes']] == ['n', 'm']


def ends(rig: Rig) -> list[str]:
    """Return an end_command that leaves a mark instead of ending this computer."""
    return ['touch', str(rig.folder / 'ended')]


def test_missing_heartbeats_end_the_machine(rig, free_udp_port):
    rig.serve(robot_timeout=2.0, end_command=ends(rig))
    client = rig.client()
    client.request('start', nodes=[rig.node('n', SLEEP)])
    node = rig.wait('started', node='n')['pid']
    client.request('configure', heartbeat={
        'bind': '127.0.0.1', 'port': free_udp_port, 'peer': '127.0.0.1', 'key': KEY})
    heartbeat = Heartbeat('127.0.0.1', free_udp_port, KEY, interval=0.1)
    begin = time.monotonic()
    wait_until(lambda: time.monotonic() - begin > 2.5, timeout=60, what='longer than the timeout')
    assert heartbeat.round_trip is not None and 0 < heartbeat.round_trip < 2.0
    assert heartbeat.age is not None and heartbeat.age < 2.0
    # the agent answers with the machine's time, here the robot's own
    offset = heartbeat.clock_offset
    assert offset is not None and abs(offset.seconds) <= offset.uncertainty + 1e-3
    assert client.request('status')['heartbeat_age'] < 2.0
    heartbeat.close()
    gone_at = time.monotonic()
    watchdog = rig.wait('watchdog')
    assert (watchdog['reason'], watchdog['action']) == ('robot gone', 'end the machine')
    assert 1.0 < time.monotonic() - gone_at < 20
    wait_until((rig.folder / 'ended').exists, timeout=60, what='the end of the machine')
    assert gone(node)()
    with pytest.raises(AgentError, match='stopping|ending'):
        client.request('start', nodes=[rig.node('late', SLEEP)])


def test_heartbeats_of_another_address_do_not_count(rig, free_udp_port):
    rig.serve(robot_timeout=0.8, end_command=ends(rig))
    rig.client().request('configure', heartbeat={
        'bind': '127.0.0.1', 'port': free_udp_port, 'peer': '127.0.0.2', 'key': KEY})
    heartbeat = Heartbeat('127.0.0.1', free_udp_port, KEY, interval=0.05)
    with contextlib.closing(heartbeat):
        assert rig.wait('watchdog')['reason'] == 'robot gone'
        assert heartbeat.round_trip is None


def test_kept_machine_stops_nodes_and_stays_for_its_lifetime(rig, free_udp_port):
    rig.serve(robot_timeout=0.5, on_exit='keep', end_command=ends(rig))
    client = rig.client()
    client.request('start', nodes=[rig.node('n', SLEEP)])
    rig.wait('started', node='n')
    client.request('configure', heartbeat={
        'bind': '127.0.0.1', 'port': free_udp_port, 'peer': '127.0.0.1', 'key': KEY})
    assert rig.wait('watchdog', reason='robot gone')['action'] == 'stop the nodes'
    rig.wait('exited', node='n')
    assert not (rig.folder / 'ended').exists()
    assert client.request('status')['heartbeat_age'] is None
    # the next launch takes it over without being asked whether it may
    client.request('configure', launch='def456')
    assert client.request('status')['nodes'] == []
    client.request('configure', lifetime=1.0)
    assert rig.wait('watchdog', reason='lifetime')['action'] == 'end the machine'
    wait_until((rig.folder / 'ended').exists, timeout=60, what='the end of the machine')


def test_computer_without_end_command_is_cleaned_up(rig):
    mark = rig.folder / 'down'
    agent = rig.serve()
    (rig.directory / 'agent.py').write_text('put there by the robot')
    (rig.directory / 'more').mkdir()
    (rig.directory / 'more' / 'file').write_text('')
    client = rig.client()
    client.request('watch', what='vpn', argv=['true'], repair=[], down=[['touch', str(mark)]])
    client.request('configure', boot_timeout=0.5)
    assert rig.wait('watchdog')['action'] == 'leave'
    assert rig.ended(agent) == 0
    assert mark.exists() and not rig.directory.exists()


def test_kept_machine_outlives_a_launch_that_dies_in_setup(rig):
    rig.serve(launch='first', on_exit='keep', boot_timeout=60.0, end_command=ends(rig))
    client = rig.client()
    client.request('release', on_exit='keep')
    client.request('configure', launch='second', boot_timeout=0.5)
    assert rig.wait('watchdog', reason='no launch came')['action'] == 'stop the nodes'
    client.request('status')
    assert not (rig.folder / 'ended').exists()


def test_kept_machine_without_launch_outlives_its_agent(rig):
    agent = rig.serve(on_exit='keep', lifetime=2.0, end_command=ends(rig))
    rig.client().request('release', on_exit='keep')
    agent.kill()
    agent.wait(60)
    rig.serve(on_exit='keep', boot_timeout=0.3, lifetime=2.0, end_command=ends(rig))
    assert rig.wait('watchdog')['reason'] == 'lifetime'


def test_kept_machine_outlives_a_reboot(rig):
    """Which empties the agent's directory; the boot's configuration knows nothing of a launch."""
    mark, boot = rig.folder / 'kept_until', {'boot_timeout': 0.3, 'end_command': ends(rig)}
    agent = rig.serve(launch='', kept_until=str(mark), **{**boot, 'boot_timeout': 60.0})
    client = rig.client()
    client.request('configure', launch='second', on_exit='keep', lifetime=1000.0,
                   boot_timeout=60.0, kept_until='/etc/passwd')
    client.request('release', launch='second')
    assert 900 < float(mark.read_text()) - time.time() <= 1000
    for left in (500, 1):
        agent.kill()
        agent.wait(60)
        shutil.rmtree(rig.directory)
        mark.write_text(f'{time.time() + left}')
        agent = rig.serve(launch='', kept_until=str(mark), **boot)
        if left == 500:
            status = rig.client().request('status')
            assert 400 < status['lifetime_left'] < 500 and status['on_exit'] == 'keep'
    rig.client()
    assert rig.wait('watchdog')['reason'] == 'lifetime'


def test_machine_of_a_later_launch_is_not_kept_after_a_reboot(rig):
    mark = rig.folder / 'kept_until'
    rig.serve(on_exit='keep', kept_until=str(mark), boot_timeout=60.0)
    client = rig.client()
    client.request('configure', launch='abc123')
    assert mark.exists()
    client.request('release', on_exit='stop')
    assert not mark.exists()


def test_machine_belongs_to_one_launch_until_its_release(rig):
    """A late request claims nothing, such as a sign of life when the connection broke."""
    rig.serve(launch='', on_exit='keep', boot_timeout=60.0)  # as after a reboot
    client = rig.client()
    client.request('configure', launch='first', force='')
    for known in ({}, {'force': ''}, {'force': 'xyz789'}):
        with pytest.raises(AgentError, match="belongs to launch 'first'"):
            client.request('configure', launch='second', **known)
    client.request('configure', launch='first', again=True)
    client.request('release', launch='first', on_exit='keep')
    with pytest.raises(AgentError, match="launch 'first' doesn't have this machine any more"):
        client.request('configure', launch='first', again=True)
    assert client.request('status')['launch'] == ''
    # nor does a release that was sent twice end the next launch
    client.request('configure', launch='second')
    client.request('release', launch='first', on_exit='keep')
    assert client.request('status')['launch'] == 'second'


def test_release_during_a_takeover_leaves_the_machine_free(rig):
    rig.serve(launch='first', on_exit='keep')
    client = rig.client()
    client.request('start', nodes=[rig.node('n', (
        'import signal, time\n'
        'signal.signal(signal.SIGINT, lambda *_: print("no"))\n'
        'signal.signal(signal.SIGTERM, signal.SIG_IGN)\n'
        'print("up")\n'
        'while True:\n'
        '    time.sleep(0.05)\n'), sigterm_timeout=0.2, sigkill_timeout=60)])
    node = rig.wait('started', node='n')['pid']
    rig.wait('output', node='n')
    refused: list[AgentError] = []

    def take() -> None:
        try:
            client.request('configure', launch='second', force='first')
        except AgentError as error:
            refused.append(error)

    taking = threading.Thread(target=take)
    taking.start()
    wait_until(lambda: 'no' in rig.text('n'), timeout=60, what='the first one to be ended')
    # the first one's own, which comes too late
    client.request('release', launch='first', on_exit='keep')
    assert client.request('status')['launch'] == 'first'
    releasing = threading.Thread(target=lambda: client.request(
        'release', launch='second', on_exit='keep'))
    releasing.start()
    wait_until(lambda: client.request('status')['launch'] == '', timeout=60, what='the release')
    os.kill(node, signal.SIGKILL)
    releasing.join(60)
    taking.join(60)
    assert 'was released meanwhile' in str(refused[0])
    assert client.request('status')['launch'] == ''


@pytest.mark.parametrize('how', [
    {'command': 'release', 'on_exit': 'keep'},
    {'command': 'configure', 'launch': 'another', 'force': 'abc123'}])
def test_health_check_ends_with_its_launch(rig, how):
    thing = rig.folder / 'thing'
    rig.serve(on_exit='keep')
    client = rig.client()
    client.request('watch', what='vpn', interval=0.05, argv=['test', '-e', str(thing)],
                   repair=[['touch', str(thing)]], down=[['rm', '-f', str(thing)]])
    wait_until(thing.exists, timeout=60, what='the repair')
    client.request(**how)
    assert not thing.exists()
    assert client.request('status')['kept'] == []


def test_watch_reports_its_command_once(rig):
    rig.serve()
    client = rig.client()
    unused = rig.folder / 'unused'
    client.request('watch', what='idle', argv=['cat', str(unused)], interval=0.05)
    client.request('ping')
    aside = rig.folder / 'aside'
    aside.write_text('since noon\n' + 'x' * 5000)
    aside.rename(unused)
    reason = rig.wait('watched', what='idle')['reason']
    assert reason.startswith('since noon\n') and len(reason) == 2000
    # a second one, for another launch: by its time the first would have told again
    client.request('configure', launch='def456', force='abc123')
    client.request('watch', what='idle', argv=['echo', 'again'], interval=0.05)
    rig.wait('watched', reason='again')
    assert len([e for e in rig.events if e['event'] == 'watched']) == 2
    for wrong in ({'what': 'notice', 'argv': ['true']}, {'what': 'idle', 'argv': []},
                  {'what': 'idle', 'argv': 'true'}, {'what': 'idle'}):
        with pytest.raises(AgentError):
            client.request('watch', **wrong)


def test_failed_end_command_is_reported(rig):
    rig.serve(boot_timeout=0.2, end_command=['false'])
    rig.client()
    assert rig.wait('end_failed')['returncode'] == 1


def test_machine_with_heartbeats_is_not_taken_over(rig, free_udp_port):
    rig.serve()
    client = rig.client()
    client.request('configure', heartbeat={
        'bind': '127.0.0.1', 'port': free_udp_port, 'peer': '127.0.0.1', 'key': KEY})
    client.request('start', nodes=[rig.node('n', SLEEP)])
    rig.wait('output', node='n')
    with pytest.raises(AgentError, match="belongs to launch 'abc123'"):
        client.request('configure', launch='def456')
    client.request('configure', launch='def456', force='abc123')
    assert rig.wait('exited', node='n')['returncode'] == -2
    status = client.request('status')
    assert (status['launch'], status['nodes'], status['heartbeat_age']) == ('def456', [], None)
    client.request('start', nodes=[rig.node('n', 'print("mine")\n')])
    wait_until(lambda: 'mine' in rig.text('n'), timeout=60, what='the new node')


def test_busy_heartbeat_port_is_refused(rig):
    rig.serve()
    client = rig.client()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.1', 0))
        with pytest.raises(AgentError, match='no heartbeats at 127.0.0.1:'):
            client.request('configure', heartbeat={
                'bind': '127.0.0.1', 'port': other.getsockname()[1], 'peer': '127.0.0.1',
                'key': KEY})


def test_health_check_repairs_and_takes_down(rig):
    thing = rig.folder / 'thing'
    agent = rig.serve()
    client = rig.client()
    client.request(
        'watch', what='vpn', interval=0.05, argv=['test', '-e', str(thing)],
        repair=[['true'], ['touch', str(thing)]], down=[['rm', str(thing)]])
    for _ in range(2):
        wait_until(thing.exists, timeout=60, what='the repair')
        count = sum(e['event'] == 'vpn_repaired' for e in list(rig.events))
        thing.unlink()
        wait_until(lambda count=count: sum(
            e['event'] == 'vpn_repaired' for e in list(rig.events)) > count,
            timeout=60, what='the event')
    wait_until(thing.exists, timeout=60, what='the repair')
    kept, = client.request('status')['kept']
    assert kept['what'] == 'vpn' and kept['repairs'] >= 2
    client.request('release', exit=True)
    assert rig.ended(agent) == 0
    assert not thing.exists()


def test_failed_repair_is_tried_again(rig):
    rig.serve()
    client = rig.client()
    client.request('watch', what='vpn', interval=0.05, argv=['false'],
                   repair=[['/no/such/program']])
    wait_until(lambda: client.request('status')['kept'][0]['ok'] is False, timeout=60,
               what='the failure')
    client.request('watch', what='vpn', interval=0.05, argv=['true'], repair=[])
    wait_until(lambda: client.request('status')['kept'][0]['ok'] is True, timeout=60,
               what='its replacement')
    assert all(e['event'] != 'vpn_repaired' for e in rig.events)


def test_release_stops_the_nodes_before_it_answers(rig):
    rig.serve(on_exit='delete')
    client = rig.client()
    client.request('start', nodes=[rig.node('n', SLEEP)])
    node = rig.wait('started', node='n')['pid']
    client.request('release', on_exit='keep')
    assert gone(node)()
    status = client.request('status')
    assert status['on_exit'] == 'keep'
    # what comes too late starts nothing
    for late in ({'command': 'start', 'nodes': [rig.node('late', SLEEP)]},
                 {'command': 'watch', 'what': 'vpn', 'argv': ['true'], 'repair': [['true']]}):
        with pytest.raises(AgentError, match='no launch has this machine any more'):
            client.request(**late)
    # and it is ready for the next one
    client.request('configure', launch='next')
    client.request('start', nodes=[rig.node('next', 'print("here")\n')])
    rig.wait('exited', node='next')


STUBBORN = (
    'import os, signal, subprocess, sys, time\n'
    'for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):\n'
    '    signal.signal(number, signal.SIG_IGN)\n'
    'child = subprocess.Popen(["sleep", "600"], start_new_session=True)\n'
    'print(os.getpid(), child.pid)\n'
    'time.sleep(600)\n')


def test_signalled_agent_ends_all_processes_soon(rig):
    agent = rig.serve()
    client = rig.client()
    client.request('start', nodes=[rig.node('n', STUBBORN)])
    wait_until(lambda: '\n' in rig.text('n'), timeout=60, what='the node')
    pids = [int(word) for word in rig.text('n').split()]
    begin = time.monotonic()
    agent.send_signal(signal.SIGTERM)
    assert rig.ended(agent) == 0
    # in one second on an idle computer; unhurried, it would send no SIGKILL before
    assert time.monotonic() - begin < SWEEP[-1][0]
    assert all(gone(pid)() for pid in pids)
    kinds = [e['event'] for e in rig.events]
    assert kinds.count('ending') == 1
    assert 'exited' not in kinds or kinds.index('ending') < kinds.index('exited')


def test_restarted_agent_ends_nodes_and_keeps_its_watchdog(rig, free_udp_port):
    first = rig.serve(robot_timeout=15.0, end_command=ends(rig))
    client = rig.client()
    client.request('configure', launch='def456', force='abc123', heartbeat={
        'bind': '127.0.0.1', 'port': free_udp_port, 'peer': '127.0.0.1', 'key': KEY})
    client.request('start', nodes=[rig.node('n', SLEEP), rig.node('stubborn', STUBBORN)])
    node = rig.wait('started', node='n')['pid']
    wait_until(lambda: '\n' in rig.text('stubborn'), timeout=60, what='the stubborn node')
    pids = [int(word) for word in rig.text('stubborn').split()]
    first.kill()
    first.wait(60)
    wait_until(gone(node), timeout=60, what='the node to end, without an agent')
    # another path than the directory's own: as a machine's boot has it
    second = rig.serve(robot_timeout=15.0, end_command=ends(rig))
    rig.wait('restarted')
    assert all(gone(pid)() for pid in pids)
    status = client.request('status')
    assert (status['pid'], status['launch']) == (second.pid, 'def456')
    assert status['heartbeat_age'] < 15.0
    seqs = [e['seq'] for e in rig.events if 'seq' in e]
    assert seqs == list(range(1, len(seqs) + 1))
    assert rig.wait('watchdog')['reason'] == 'robot gone'


@pytest.fixture
def login(root: None) -> Iterator[Path]:
    """Give a folder that the user nobody can reach, and skip where we can't become that user."""
    if os.geteuid() != 0:
        pytest.skip('needs to run as root')
    folder = Path(tempfile.mkdtemp(prefix='agent-test-', dir='/run'))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def test_root_agent_runs_nodes_as_the_login_user(login, tmp_path):
    rig = Rig(tmp_path)
    rig.directory = login / 'agent'
    record = login / 'record'
    record.mkdir(mode=0o777)
    record.chmod(0o777)
    script = (f'id -u > {record}/id; id -G >> {record}/id; pwd >> {record}/id; '
              f'echo $USER $HOME >> {record}/id; '
              f'grep -E "Uid|Groups" /proc/self/status >> {record}/id; '
              f'echo ${{LC_SECRET:-unset}} >> {record}/id; mv {record}/id {record}/done; cat')
    os.environ['LC_SECRET'] = 'of the agent'
    try:
        agent = rig.serve(user='nobody', environment={})
    finally:
        del os.environ['LC_SECRET']
    nobody = pwd.getpwnam('nobody')
    for path in [rig.directory, *rig.directory.iterdir()]:
        assert path.stat().st_uid == nobody.pw_uid
        assert path.stat().st_mode & 0o077 == 0
    client = rig.client()
    client.request('start', nodes=[NodeSpec('n', 'n-1', arguments=('sh', '-c', script))])
    wait_until((record / 'done').exists, timeout=60, what='the record')
    lines = (record / 'done').read_text().splitlines()
    assert lines[0] == str(nobody.pw_uid)
    assert lines[1].split() == [str(g) for g in os.getgrouplist('nobody', nobody.pw_gid)]
    assert lines[2] == (nobody.pw_dir if os.path.isdir(nobody.pw_dir) else '/')
    assert lines[3] == f'nobody {nobody.pw_dir}'
    assert lines[4].split()[1:] == [str(nobody.pw_uid)] * 4
    assert lines[-1] == 'unset'
    client.request('watch', what='vpn', argv=['sh', '-c', f'id -u > {record}/root'],
                   repair=[], interval=0.1)
    wait_until(lambda: (record / 'root').exists() and (record / 'root').read_text() == '0\n',
               timeout=60, what='a command as root')
    client.request('release', exit=True)
    assert rig.ended(agent) == 0
    assert not rig.directory.exists()
    rig.close()


def test_root_agent_refuses_a_foreign_directory(login, tmp_path):
    rig = Rig(tmp_path)
    rig.directory = login / 'agent'
    rig.directory.mkdir()
    (login / 'link').symlink_to(tmp_path)
    for directory in (rig.directory, login / 'link'):
        rig.directory = directory
        agent = rig.serve(user='nobody')
        assert agent.wait(60) == 1
        assert agent.stderr is not None
        assert 'belongs to somebody else' in agent.stderr.read().decode()
    rig.close()


def test_agent_as_process_1_reaps_orphans_and_ends(root, tmp_path):
    if os.geteuid() != 0:
        pytest.skip('needs to run as root')
    if subprocess.run(['unshare', '--pid', '--fork', '--mount-proc', 'true'],
                      capture_output=True).returncode != 0:
        pytest.skip('needs process namespaces')
    rig = Rig(tmp_path)
    agent = subprocess.Popen(
        ['unshare', '--pid', '--fork', '--kill-child', '--mount-proc', sys.executable, '-IS',
         str(rig.program), 'serve', '--config', str(rig.config())], stderr=subprocess.PIPE)
    rig.agents.append(agent)
    wait_until(rig.can_connect, timeout=60, what='the agent')
    client = rig.client()
    assert client.request('status')['pid'] == 1
    client.request('start', nodes=[rig.node('n', (
        'import subprocess, time\n'
        'for _ in range(5):\n'
        '    subprocess.run(["sh", "-c", "sleep 0.1 & exit"])\n'
        'time.sleep(0.5)\n'
        'stat = subprocess.run("cat /proc/[0-9]*/stat", shell=True, capture_output=True).stdout\n'
        'print(stat.count(b") Z 1 "))\n'))])
    rig.wait('exited', node='n')
    assert rig.text('n') == '0\n'
    inner = int(Path(f'/proc/{agent.pid}/task/{agent.pid}/children').read_text())
    begin = time.monotonic()
    os.kill(inner, signal.SIGTERM)
    assert rig.ended(agent) == 0
    # in one second on an idle computer; unhurried, it would send no SIGKILL before
    assert time.monotonic() - begin < SWEEP[-1][0]
    rig.close()
