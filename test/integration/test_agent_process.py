# SPDX-License-Identifier: Apache-2.0
"""The agent as a process, its nodes as real processes, the client over a pipe."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
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
from typing import Any

import pytest

from fogros2.agent.processes import SWEEP
from fogros2.agent.protocol import Refused
from fogros2.agent.server import Agent
from fogros2.agent_client import AgentClient, connection, Heartbeat
from fogros2.errors import AgentError
from fogros2.model import NodeSpec
from fogros2.waiting import wait_until
from rigs.agents import gone, KEY, Raw, Rig


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


@pytest.fixture(scope='module')
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Run one agent for the tests that only run nodes of their own."""
    rig = Rig(tmp_path_factory.mktemp('shared'))
    rig.started()
    yield rig
    rig.close()


@pytest.fixture
def heartbeat(free_udp_port: int) -> dict[str, Any]:
    """Return settings of heartbeats."""
    return {'bind': '127.0.0.1', 'port': free_udp_port, 'peer': '127.0.0.1', 'key': KEY}


def states(client: AgentClient) -> dict[str, str]:
    return {node['id']: node['state'] for node in client.request('status')['nodes']}


SLEEP = 'import time\nprint("up")\ntime.sleep(600)\n'


def test_output_and_exit_status_of_a_node_arrive(rig):
    client = rig.started()
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


def test_signals_and_negative_exit_statuses(shared):
    client = shared.clients[0]
    shared.run(
        shared.node('signalled', (
            'import signal, sys, time\n'
            'signal.signal(signal.SIGUSR1, lambda *_: sys.exit(42))\n'
            'print("up")\ntime.sleep(600)\n')),
        shared.node('killed', SLEEP))
    client.request('signal', node='signalled', signal='SIGUSR1')
    client.request('signal', node='killed', signal='SIGKILL')
    assert shared.wait('exited', node='signalled')['returncode'] == 42
    assert shared.wait('exited', node='killed')['returncode'] == -9
    with pytest.raises(AgentError, match="isn't running"):
        client.request('signal', node='killed', signal='SIGINT')
    with pytest.raises(AgentError, match="no signal 'SIGNONSENSE'"):
        client.request('signal', node='killed', signal='SIGNONSENSE')


def test_nodes_start_as_their_specs_say(shared):
    """A program that cannot be executed harms no other, and a second request starts nothing."""
    client = shared.clients[0]
    (shared.folder / 'broken').write_bytes(b'\x7fELFnot')
    (shared.folder / 'broken').chmod(0o700)
    nodes = [
        NodeSpec('cat', 'c-1', arguments=('cat',)),
        NodeSpec('broken', 'b-1', arguments=(str(shared.folder / 'broken'),)),
        NodeSpec('shell', 's-1', shell=True,  # noqa: S604 (a constant)
                 arguments=('echo one two | tr a-z', 'A-Z')),
        NodeSpec('tty', 't-1', arguments=('test', '-t', '1'), emulate_tty=True),
        NodeSpec('prefix', 'p-1', arguments=('echo', 'hi'), prefix=('env', 'X=1')),
        shared.node('binary', (
            'import os, time\n'
            'os.write(1, b"\\xff\\xfe\\x00ok \\xc3")\n'
            'time.sleep(0.1)\n'  # splits a character in two
            'os.write(1, b"\\xa9 no newline \\xe2\\x82")\n'))]
    assert client.request('start', nodes=nodes)['known'] == []
    assert client.request('start', nodes=nodes)['known'] == [node.id for node in nodes]
    for node in ('shell', 'tty', 'prefix', 'binary'):
        assert shared.wait('exited', node=node)['returncode'] == 0
    assert (shared.text('shell'), shared.text('prefix')) == ('ONE TWO\n', 'hi\n')
    assert shared.text('binary') == '\ufffd\ufffd\ufffdok \u00e9 no newline \ufffd'
    assert 'could not be executed' in shared.wait('refused', node='broken')['error']
    # its input has no end
    assert states(client)['cat'] == 'running' and states(client)['broken'] == 'refused'
    assert [e['node'] for e in shared.events if e['event'] == 'started'].count('shell') == 1


def test_nodes_respawn_as_their_specs_say(shared):
    client = shared.clients[0]
    client.request('start', nodes=[
        shared.node('fails', 'raise SystemExit(1)\n', respawn=True, respawn_max_retries=2),
        shared.node('again', SLEEP, respawn=True, respawn_delay=0.2),
        shared.node('stopped', 'raise SystemExit(3)\n', respawn=True, respawn_delay=0.3)])
    shared.wait('exited', node='stopped', respawns=True)
    client.request('stop', nodes=['stopped'])
    first = shared.wait('started', node='again')['pid']
    os.kill(first, signal.SIGKILL)
    exited = shared.wait('exited', node='again', returncode=-9, respawns=True)
    second = wait_until(lambda: next((
        e for e in list(shared.events) if e['event'] == 'started' and e['node'] == 'again'
        and e['pid'] != first), None), timeout=60, what='the second start')
    assert second['time'] - exited['time'] >= 0.2
    shared.wait('exited', node='fails', respawns=False)
    assert [e['respawns'] for e in shared.events
            if e['event'] == 'exited' and e['node'] == 'fails'] == [True, True, False]
    client.request('start', nodes=[shared.node('later', 'import time\ntime.sleep(0.6)\n')])
    shared.wait('exited', node='later')
    nodes = {node['id']: node for node in client.request('status')['nodes']}
    assert nodes['fails']['restarts'] == 2
    assert (nodes['stopped']['state'], nodes['stopped']['pid']) == ('exited', None)
    client.request('stop', nodes=['again'])


def test_stop_goes_from_sigint_to_sigkill(rig):
    client = rig.started()
    stubborn = (
        'import signal, time\n'
        'for number in (signal.SIGINT, signal.SIGTERM):\n'
        '    signal.signal(number, lambda n, _: print("not", n))\n'
        'print("up")\n'
        'while True:\n'
        '    time.sleep(0.05)\n')
    rig.run(rig.node('stubborn', stubborn, sigterm_timeout=0.2, sigkill_timeout=0.2, respawn=True),
            rig.node('polite', SLEEP))
    client.request('stop', nodes=['stubborn'])
    exited = rig.wait('exited', node='stubborn')
    assert (exited['returncode'], exited['respawns']) == (-9, False)
    assert 'not 2\n' in rig.text('stubborn') and 'not 15\n' in rig.text('stubborn')
    assert states(client) == {'stubborn': 'exited', 'polite': 'running'}
    client.request('stop', nodes=None)
    assert rig.wait('exited', node='polite')['returncode'] == -2


def test_stop_interrupts_the_children_of_a_node_as_ctrl_c(shared):
    saves = (
        'import signal, sys, time\n'
        'signal.signal(signal.SIGINT, lambda *_: sys.exit("saved"))\n'
        'print("up", flush=True)\n'
        'time.sleep(600)\n')
    (shared.folder / 'saves.py').write_text(saves)
    # a shell waits for its command, and 'ros2 run' for its program
    shared.run(NodeSpec('wrapped', 'w-1', arguments=(
        'sh', '-c', f'{sys.executable} {shared.folder}/saves.py; exit 3')))
    shared.clients[0].request('stop', nodes=['wrapped'])
    shared.wait('exited', node='wrapped')
    assert shared.text('wrapped', 'stderr') == 'saved\n'


def test_lost_connection_loses_and_repeats_no_event(rig):
    rig.started().request('start', nodes=[rig.node('n', (
        'import time\n'
        'for n in range(100):\n'
        '    print(n)\n'
        '    time.sleep(0.01)\n'))])

    def connections() -> list[str]:
        return [e['state'] for e in list(rig.events) if e['event'] == 'connection']

    for number, count in enumerate((20, 60), 1):
        wait_until(lambda count=count: len(rig.text('n').split()) > count, timeout=60,
                   what='lines', longest=0.02)
        rig.shell.cut()
        # lines of the lost connection may count for the next cut
        wait_until(lambda number=number: connections().count('back') == number, timeout=60,
                   what='the connection', longest=0.02)
    rig.wait('exited', node='n')
    assert rig.text('n').split() == [str(n) for n in range(100)]
    seqs = [e['seq'] for e in rig.events if 'seq' in e]
    assert seqs == list(range(1, len(seqs) + 1))
    assert connections() == 2 * ['lost', 'back']


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
    (b'{"command": "release", "exit": "keep"}\n', "'exit' is true or false"),
    (b'{"command": "configure", "lifetime": -1}\n', "'lifetime' has to be above 0"),
    (b'{"command": "configure", "environment": {"A=B": "x"}}\n', "can't set"),
    (b'{"command": "watch", "what": "x", "argv": "ls"}\n', 'no list of words'),
    (b'{"command": "log", "from": "x"}\n', 'malformed request'),
]


def test_invalid_requests_are_refused_and_connection_stays(shared):
    raw = Raw(shared.directory)
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
    assert shared.agents[0].poll() is None


def test_output_and_clients_fill_neither_memory_nor_disk(rig):
    rig.serve(log_bytes=2 << 20)
    silent = Raw(rig.directory)
    silent.ask(b'{"id": 1, "command": "log"}\n')
    for data in (b'{"id": 1, "comm', b'', b'{"id": 1, "command": "status"}\n' * 50):
        raw = Raw(rig.directory)
        raw.link.sendall(data)
        raw.close()
    crowd = [Raw(rig.directory) for _ in range(100)]  # beyond what is kept open
    assert crowd[-1].ask(b'{"id": 1, "command": "status"}\n')['ok']
    for raw in crowd:
        raw.close()
    client = rig.client(follow=False)
    client.request('start', nodes=[rig.node('n', (
        'import sys\n'
        'block = b"x" * 99 + b"\\n"\n'
        'for _ in range(3000):\n'
        '    sys.stdout.buffer.write(block * 100)\n'))])  # 30 MB
    wait_until(lambda: states(client)['n'] == 'exited', timeout=60, what='the node')
    status = client.request('status')
    assert status['rss_kb'] < 30_000
    sizes = [path.stat().st_size for path in rig.directory.glob('events*.jsonl')]
    assert len(sizes) == 2 and sum(sizes) < 5 << 20
    assert status['first'] > 1
    client.subscribe(rig.events.append, since=1)
    rig.wait('exited', node='n')
    assert rig.events[0] == {'event': 'gap', 'count': status['first'] - 1}
    assert [e['seq'] for e in rig.events[1:]] == list(range(status['first'], status['next']))
    silent.close()


def test_slow_connection_loses_events_and_counts_them(rig, monkeypatch):
    monkeypatch.setattr(connection, 'SILENCE', 600.0)
    client = rig.started(log_bytes=64 << 10)
    first = rig.node('first', 'import sys\nprint("up")\nfor line in sys.stdin: pass\n')
    rig.run(first)
    rig.shell.pause()
    other = rig.client(follow=False)
    flood = 'for _ in range(5000):\n    print("x" * 200)\n'
    for name, code in (('before', flood), ('between', 'raise SystemExit(7)\n'),
                       ('after', flood)):
        other.request('start', nodes=[rig.node(name, code)])
        wait_until(lambda name=name: states(other)[name] == 'exited', timeout=60, what=name)
    rig.shell.streams[0]._channel.child.send_signal(signal.SIGCONT)
    rig.wait('exited', node='after')
    assert not [e for e in rig.events if e.get('node') == 'between'], 'nothing was lost'
    rig.wait('gap')
    assert sum(e['count'] for e in rig.events if e['event'] == 'gap') == (
        rig.events[-1]['seq'] - sum('seq' in e for e in rig.events))
    status, = (node for node in client.status()['nodes'] if node['id'] == 'between')
    assert (status['state'], status['returncode']) == ('exited', 7)


def test_nodes_beyond_the_descriptors_are_refused(rig):
    rig.prefix = ('sh', '-c', 'ulimit -n 40 && exec "$@"', 'sh')
    client = rig.started()
    mark = rig.folder / 'looked'
    client.request('watch', what='vpn', interval=0.05, argv=['touch', str(mark)], repair=[])
    nodes = [rig.node(str(number), SLEEP) for number in range(30)]
    client.request('start', nodes=nodes)
    found = states(client)
    assert {'running', 'refused'} == set(found.values()) and found['0'] == 'running'
    crowd = [Raw(rig.directory) for _ in range(10)]  # which take the rest
    running = [name for name, state in found.items() if state == 'running']
    client.request('ping')
    client.request('stop', nodes=running[1:])
    for name in running[1:]:
        rig.wait('exited', node=name)
    mark.unlink(missing_ok=True)
    wait_until(mark.exists, timeout=60, what='the watch to go on')
    assert all(raw.ask(b'{"id": 1, "command": "ping"}\n')['ok'] for raw in crowd)
    assert states(client)['0'] == 'running' and rig.agents[0].poll() is None
    for raw in crowd:
        raw.close()


def test_agent_may_have_more_descriptors_than_its_nodes(rig):
    rig.prefix = ('sh', '-c', 'ulimit -Sn 40 && exec "$@"', 'sh')
    rig.started()
    rig.run(*(rig.node(str(number), (
        'import resource, time\n'
        'print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])\n'
        'time.sleep(600)\n')) for number in range(20)))
    assert {rig.text(str(number)) for number in range(20)} == {'40\n'}


def test_requests_are_answered_after_the_end_of_input(shared, tmp_path):
    def connect(directory: Path) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            [sys.executable, '-IS', str(shared.program), 'connect', '--directory',
             str(directory)],
            input=b'{"id": 9, "command": "log", "from": 99999}\n{"id": 8, "command": "status"}\n',
            capture_output=True, timeout=60)

    absent = connect(tmp_path)
    assert (absent.returncode, json.loads(absent.stdout)['kind']) == (3, 'absent')
    done = connect(shared.directory)
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
])
def test_invalid_configuration_is_refused(tmp_path, config, reason):
    with pytest.raises(Refused, match=reason):
        Agent({'machine': 'planner', 'directory': str(tmp_path / 'agent'), **config}).open()


@pytest.mark.parametrize('words', [(), ('--detach',)])
def test_damaged_configuration_is_reported_in_one_line(tmp_path, words):
    done = subprocess.run(
        Rig(tmp_path).words(*words, directory=''), capture_output=True, timeout=60)
    line = done.stdout if words else done.stderr
    assert (done.returncode, line.count(b'\n')) == (1, 1)
    assert "names no 'directory'" in (json.loads(line)['error'] if words else line.decode())


def test_setup_files_are_sourced(rig):
    setup = rig.folder / "it's a setup.bash"
    setup.write_text('echo printed\nexport SOURCED="from ${BASH_SOURCE[0]##*/} $# $LISTED"\n')
    client = rig.started(setup=[str(setup)], environment={
        'LISTED': 'configured', 'PATH': os.environ['PATH']})
    rig.run(rig.node('n', 'import os\nprint(os.environ["SOURCED"])\n'))
    assert rig.text('n') == "from it's a setup.bash 0 configured\n"
    client.request('configure', environment={'LISTED': 'later', 'PATH': os.environ['PATH']})
    rig.run(rig.node('m', 'import os\nprint(os.environ["SOURCED"])\n'))
    assert rig.text('m') == "from it's a setup.bash 0 later\n"
    client.request('configure', setup=['/no/such/setup.bash'])
    with pytest.raises(AgentError, match='setup.bash to be sourced is not there'):
        client.request('start', nodes=[rig.node('later', SLEEP)])
    setup.write_text('exit 3\n')
    client.request('configure', setup=[str(setup)], environment={'PATH': os.environ['PATH']})
    with pytest.raises(AgentError, match="can't be sourced: exit status 3"):
        client.request('start', nodes=[rig.node('later', SLEEP)])
    assert list(states(client)) == ['n', 'm']


def ends(rig: Rig) -> list[str]:
    """Return an end_command that leaves a mark instead of ending this computer."""
    return ['touch', str(rig.folder / 'ended')]


def test_missing_heartbeats_end_the_machine(rig, heartbeat):
    client = rig.started(robot_timeout=2.0, end_command=ends(rig))
    client.request('start', nodes=[rig.node('n', SLEEP)])
    node = rig.wait('started', node='n')['pid']
    client.request('configure', heartbeat=heartbeat)
    robot = Heartbeat('127.0.0.1', heartbeat['port'], KEY, interval=0.1)
    begin = time.monotonic()
    wait_until(lambda: time.monotonic() - begin > 2.5, timeout=60, what='longer than the timeout')
    assert robot.round_trip is not None and 0 < robot.round_trip < 2.0
    assert robot.age is not None and robot.age < 2.0
    # the agent answers with the machine's time, here the robot's own
    offset = robot.clock_offset
    assert offset is not None and abs(offset.seconds) <= offset.uncertainty + 1e-3
    assert client.request('status')['heartbeat_age'] < 2.0
    robot.close()
    gone_at = time.monotonic()
    watchdog = rig.wait('watchdog')
    assert (watchdog['reason'], watchdog['action']) == ('robot gone', 'end the machine')
    assert 1.0 < time.monotonic() - gone_at < 20
    wait_until((rig.folder / 'ended').exists, timeout=60, what='the end of the machine')
    assert gone(node)()
    with pytest.raises(AgentError, match='stopping|ending'):
        client.request('start', nodes=[rig.node('late', SLEEP)])


def test_heartbeats_of_another_address_do_not_count(rig, heartbeat):
    rig.started(robot_timeout=0.8, end_command=['false']).request(
        'configure', heartbeat={**heartbeat, 'peer': '127.0.0.2'})
    robot = Heartbeat('127.0.0.1', heartbeat['port'], KEY, interval=0.05)
    with contextlib.closing(robot):
        assert rig.wait('watchdog')['reason'] == 'robot gone'
        assert robot.round_trip is None
    assert rig.wait('end_failed')['returncode'] == 1


def test_kept_machine_stops_nodes_and_stays_for_its_lifetime(rig, heartbeat):
    client = rig.started(robot_timeout=0.5, on_exit='keep', end_command=ends(rig))
    client.request('start', nodes=[rig.node('n', SLEEP)])
    rig.wait('started', node='n')
    client.request('configure', heartbeat=heartbeat)
    assert rig.wait('watchdog', reason='robot gone')['action'] == 'stop the nodes'
    rig.wait('exited', node='n')
    assert client.request('status')['heartbeat_age'] is None
    # the next launch takes it over without being asked whether it may, and dies in its setup
    client.request('configure', launch='def456', boot_timeout=0.5)
    assert client.request('status')['nodes'] == []
    assert rig.wait('watchdog', reason='no launch came')['action'] == 'stop the nodes'
    assert not (rig.folder / 'ended').exists()
    client.request('configure', lifetime=1.0)
    assert rig.wait('watchdog', reason='lifetime')['action'] == 'end the machine'
    wait_until((rig.folder / 'ended').exists, timeout=60, what='the end of the machine')


def test_nodes_that_start_after_a_long_cut_are_guarded(rig, heartbeat):
    client = rig.started(robot_timeout=3.0, on_exit='keep', end_command=ends(rig))
    client.request('start', nodes=[rig.node(
        'again', 'raise SystemExit(3)\n', respawn=True, respawn_delay=600.0)])
    rig.wait('exited', node='again', respawns=True)
    client.request('configure', heartbeat=heartbeat)
    rig.wait('watchdog', reason='robot gone')
    assert rig.wait('exited', node='again', respawns=False)['returncode'] == 3
    # the launch reaches it again, and one of its event handlers starts a node
    with contextlib.closing(Heartbeat('127.0.0.1', heartbeat['port'], KEY, interval=0.05)):
        client.request('start', nodes=[rig.node('late', SLEEP)])
        assert client.request('status')['heartbeat_age'] is not None
    rig.wait('exited', node='late')
    assert sum(event.get('reason') == 'robot gone' for event in rig.events) == 2
    assert not (rig.folder / 'ended').exists()


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
    assert agent.wait(60) == 0
    assert mark.exists() and not rig.directory.exists()


def test_agent_without_nodes_and_clients_leaves_at_once(rig):
    assert rig.serve(boot_timeout=0.5).wait(30) == 0
    assert not rig.directory.exists()


def test_kept_machine_without_launch_outlives_its_agent(rig):
    client = rig.started(on_exit='keep', lifetime=3.0, end_command=ends(rig))
    client.request('release', on_exit='keep')

    def left() -> float:
        seconds: float = rig.ask('status')['lifetime_left']
        return seconds

    wait_until(lambda: left() < 1.5, timeout=60, what='half of the lifetime')
    rig.kill()
    rig.serve(on_exit='keep', boot_timeout=0.3, lifetime=3.0, end_command=ends(rig))
    assert left() < 1.5
    assert rig.wait('watchdog')['reason'] == 'lifetime'


def test_kept_machine_outlives_a_reboot(rig):
    """Which empties the agent's directory; the boot's configuration knows nothing of a launch."""
    mark, boot = rig.folder / 'kept_until', {'boot_timeout': 60.0, 'end_command': ends(rig)}
    client = rig.started(launch='', kept_until=str(mark), **boot)
    client.request('configure', launch='second', on_exit='keep', lifetime=1000.0,
                   boot_timeout=60.0, kept_until='/etc/passwd')
    client.request('release', launch='second')
    assert 900 < float(mark.read_text()) - time.time() <= 1000
    rig.kill()
    shutil.rmtree(rig.directory)
    mark.write_text(f'{time.time() + 500}')
    client = rig.started(launch='', kept_until=str(mark), **{**boot, 'boot_timeout': 0.001})
    status = client.request('status')
    assert 400 < status['lifetime_left'] < 500 and status['on_exit'] == 'keep'
    assert not [event for event in rig.events if event['event'] == 'watchdog']
    # a later launch does not keep it
    client.request('configure', launch='third', boot_timeout=60.0)
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
    client = rig.started(launch='first', on_exit='keep')
    rig.run(rig.node('n', (
        'import signal, time\n'
        'signal.signal(signal.SIGINT, lambda *_: print("no"))\n'
        'signal.signal(signal.SIGTERM, signal.SIG_IGN)\n'
        'print("up")\n'
        'while True:\n'
        '    time.sleep(0.05)\n'), sigterm_timeout=0.2, sigkill_timeout=60))
    node = rig.wait('started', node='n')['pid']
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


@pytest.mark.parametrize('busy', ['nodes', 'commands'])
def test_takeover_goes_on_after_a_lost_connection(rig, busy):
    """While the former launch's nodes, or the commands of its watches, end."""
    client = rig.started(launch='first', on_exit='keep')
    go, done, again = (rig.folder / name for name in ('go', 'done', 'again'))
    wait = f'until [ -e {go} ]; do sleep 0.02; done; touch {done}'
    if busy == 'nodes':
        rig.run(NodeSpec('n', 'n-1', arguments=(
            'sh', '-c', f'trap "" TERM; trap "{wait}; exit" INT; echo up; '
            'while true; do sleep 0.02; done'), sigterm_timeout=60.0))
    else:
        client.request('watch', what='vpn', argv=['true'], repair=[],
                       down=[['sh', '-c', f'touch {again}; {wait}']])
    answers: list[Any] = []

    def take() -> None:
        answers.append(client.request('configure', launch='second', force='first'))
        answers.append(done.exists())

    taking = threading.Thread(target=take)
    taking.start()
    if busy == 'commands':
        wait_until(again.exists, timeout=60, what='the command')
    rig.shell.cut()
    rig.wait('connection', state='back')
    client.request('ping')
    go.touch()
    taking.join(60)
    assert answers[0]['ok'] and answers[1]
    assert client.request('status')['launch'] == 'second'


def test_health_check_repairs_until_its_launch_ends(rig):
    thing = rig.folder / 'thing'
    client = rig.started(on_exit='keep')
    client.request('watch', what='vpn', interval=0.05, argv=['false'],
                   repair=[['/no/such/program']])
    wait_until(lambda: client.request('status')['kept'][0]['ok'] is False, timeout=60,
               what='the failure')
    assert all(event['event'] != 'vpn_repaired' for event in rig.events)
    for how in ({'command': 'configure', 'launch': 'another', 'force': 'abc123'},
                {'command': 'release', 'exit': True}):
        # it takes the place of the former one
        client.request('watch', what='vpn', interval=0.05, argv=['test', '-e', str(thing)],
                       repair=[['true'], ['touch', str(thing)]], down=[['rm', str(thing)]])
        wait_until(thing.exists, timeout=60, what='the repair')
        before = sum(event['event'] == 'vpn_repaired' for event in list(rig.events))
        thing.unlink()
        wait_until(lambda before=before: sum(
            event['event'] == 'vpn_repaired' for event in list(rig.events)) > before,
            timeout=60, what='the event')
        wait_until(lambda: client.request('status')['kept'][0]['ok'] and thing.exists(),
                   timeout=60, what='the repair')
        assert client.request('status')['kept'][0]['repairs'] >= 1
        client.request(**how)
        wait_until(lambda: not thing.exists(), timeout=60, what='the end of the thing')
    assert rig.agents[0].wait(60) == 0


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


def test_machine_with_heartbeats_is_not_taken_over(rig, heartbeat):
    client = rig.started()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.1', 0))
        with pytest.raises(AgentError, match='no heartbeats at 127.0.0.1:'):
            client.request('configure', heartbeat={
                **heartbeat, 'port': other.getsockname()[1]})
    client.request('configure', heartbeat=heartbeat)
    rig.run(rig.node('n', SLEEP))
    with pytest.raises(AgentError, match="belongs to launch 'abc123'"):
        client.request('configure', launch='def456')
    client.request('configure', launch='def456', force='abc123')
    assert rig.wait('exited', node='n')['returncode'] == -2
    status = client.request('status')
    assert (status['launch'], status['nodes'], status['heartbeat_age']) == ('def456', [], None)
    client.request('start', nodes=[rig.node('n', 'print("mine")\n')])
    wait_until(lambda: 'mine' in rig.text('n'), timeout=60, what='the new node')


@pytest.mark.parametrize('command, arguments', [
    ('stop', {'nodes': None}), ('signal', {'node': 'n', 'signal': 'SIGKILL'}),
    ('start', {'nodes': [NodeSpec('late', 'late-1', arguments=('true',))]}),
    ('watch', {'what': 'vpn', 'argv': ['true']}), ('ping', {}), ('status', {})])
def test_a_launch_that_lost_the_computer_rules_no_nodes_there(
    rig, command, arguments, monkeypatch,
):
    """Its robot was out of reach while its agent ended and another launch came."""
    monkeypatch.setattr(connection, 'RESTART', 0.2)
    late = rig.started()
    late.request('configure', launch='abc123', again=True)
    rig.client().request('configure', launch='def456', force='abc123')
    rig.run(rig.node('n', SLEEP))
    # a signal is not sent again over the next connection
    with pytest.raises(AgentError, match="launch 'def456' has this machine now|lost meanwhile"):
        late.request(command, **arguments)
    rig.wait('connection', state='absent')
    assert states(rig.clients[-1]) == {'n': 'running'}
    assert rig.ask('status')['kept'] == []


def test_release_stops_the_nodes_before_it_answers(rig):
    client = rig.started(on_exit='delete')
    rig.run(rig.node('n', (
        'import os, subprocess, time\n'
        'child = subprocess.Popen(["sleep", "600"], start_new_session=True)\n'
        'print(os.getpid(), child.pid)\n'
        'time.sleep(600)\n')))
    client.request('release', on_exit='keep')
    assert all(gone(int(pid))() for pid in rig.text('n').split())
    assert client.request('status')['on_exit'] == 'keep'
    # what comes too late starts nothing
    for late in ({'command': 'start', 'nodes': [rig.node('late', SLEEP)]},
                 {'command': 'watch', 'what': 'vpn', 'argv': ['true'], 'repair': [['true']]}):
        with pytest.raises(AgentError, match='no launch has this machine any more'):
            client.request(**late)
    # and it is ready for the next one
    client.request('configure', launch='next')
    rig.run(rig.node('next', 'print("here")\n'))


STUBBORN = (
    'import os, signal, subprocess, sys, time\n'
    'for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):\n'
    '    signal.signal(number, signal.SIG_IGN)\n'
    'child = subprocess.Popen(["sleep", "600"], start_new_session=True)\n'
    'print(os.getpid(), child.pid)\n'
    'time.sleep(600)\n')


def test_signalled_agent_ends_all_processes_soon(rig):
    agent = rig.serve()
    rig.client()
    rig.run(rig.node('n', STUBBORN))
    pids = [int(word) for word in rig.text('n').split()]
    begin = time.monotonic()
    agent.send_signal(signal.SIGTERM)
    assert agent.wait(60) == 0
    # in one second on an idle computer; unhurried, it would send no SIGKILL before
    assert time.monotonic() - begin < SWEEP[-1][0]
    assert all(gone(pid)() for pid in pids)
    kinds = [e['event'] for e in rig.events]
    assert kinds.count('ending') == 1
    assert 'exited' not in kinds or kinds.index('ending') < kinds.index('exited')


def test_restarted_agent_ends_nodes_and_keeps_its_watchdog(rig, heartbeat):
    client = rig.started(robot_timeout=15.0, end_command=ends(rig))
    client.request('configure', launch='def456', force='abc123', heartbeat=heartbeat)
    rig.run(rig.node('n', SLEEP), rig.node('stubborn', STUBBORN))
    node = rig.wait('started', node='n')['pid']
    pids = [int(word) for word in rig.text('stubborn').split()]
    rig.kill()
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


@pytest.mark.parametrize('early', [False, True])
def test_restarted_agent_gets_its_watches_again(rig, early):
    """Also one whose predecessor had no event yet."""
    notice = ['cat', str(rig.folder / 'notice')]
    client = rig.started(notice=notice)
    if early:
        client.status()
    else:
        rig.run(rig.node('n', 'print("up")\n'))
    rig.kill()
    # a machine's boot knows of no notice, and the folder is the user's
    rig.serve()
    rig.wait('restarted')
    (rig.folder / 'notice').write_text('soon')
    for _ in range(2):
        rig.events.clear()
        client.request('configure', launch='abc123', again=True, notice=notice)
        assert rig.wait('notice')['reason'] == 'soon'
    with pytest.raises(AgentError, match='is fixed'):
        client.request('configure', launch='abc123', again=True, notice=['true'])


def test_deadlines_are_kept_on_a_full_disk(tmp_path):
    agent = Agent({'machine': 'planner', 'launch': 'abc123', 'directory': str(tmp_path / 'agent')})
    agent.open()
    path = tmp_path / 'agent' / 'watchdog.json'
    before = path.stat()
    agent.watchdog.configured(123456.789012345, heartbeat=True)
    agent.watchdog.beat((1 << 64) - 1, 123456.789012345)
    agent.save_deadlines()
    # no new block is needed
    after = path.stat()
    assert (after.st_ino, after.st_size) == (before.st_ino, before.st_size)
    assert json.loads(path.read_text())[1:] == agent.watchdog.state
    agent.listener.close()
    os.close(agent.lock)


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
    assert agent.wait(60) == 0
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
        ['unshare', '--pid', '--fork', '--kill-child', '--mount-proc', *rig.words()],
        stderr=subprocess.PIPE)
    rig.agents.append(agent)
    wait_until(lambda: rig.ask('ping').get('ok', False), timeout=60, what='the agent')
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
    assert agent.wait(60) == 0
    # in one second on an idle computer; unhurried, it would send no SIGKILL before
    assert time.monotonic() - begin < SWEEP[-1][0]
    rig.close()
