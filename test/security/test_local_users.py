# SPDX-License-Identifier: Apache-2.0
"""
Another account of the robot's computer cannot stop what FogROS2 does for its users.

The account is ``nobody``: it owns nothing and belongs to no group.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import os
from pathlib import Path
import re
import shlex
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
import urllib.parse

import pytest

from fogros2 import process, ros2_daemon
from fogros2.model import Command
from fogros2.shell import relay
from fogros2.store import Store
from fogros2.waiting import in_thread, wait_until
from fogros2_features.guests.program import Door
from fogros2_monitor import access, accounts, addresses, credentials, request, verbs
from fogros2_monitor.browser import Ticket
from fogros2_monitor.dashboard.server import Dashboard
from fogros2_monitor.gate import Gate
from fogros2_monitor.tunnel import Tunnel
from fogros2_testing.fakes import FakeShell
from rigs import loops
from rigs.stranger import stranger

ROOT = Path(__file__).resolve().parents[2]
HELPER = ROOT / 'packaging/vpn_helper/vpn.py'
#: Loads the VPN helper as ``vpn``.
LOADED = f"""\
import importlib.util, os, shutil, signal, subprocess, sys, tempfile, time
from pathlib import Path
spec = importlib.util.spec_from_file_location('vpn_helper', {str(HELPER)!r})
vpn = sys.modules['vpn_helper'] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(vpn)
"""
#: Another account opens the helper's folder and locks it; then root makes a name a user's own.
LOCKED = LOADED + """\
top = Path(tempfile.mkdtemp(dir='/run'))
top.chmod(0o755)
def late(*_):
    raise TimeoutError('it waits for the lock')
signal.signal(signal.SIGALRM, late)
vpn.RECORDS = top / 'records'
try:
    vpn.prepare()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.setgroups([]), os.setgid(65534), os.setuid(65534)
        try:
            held = os.open(vpn.RECORDS, os.O_RDONLY)
            vpn.fcntl.flock(held, vpn.fcntl.LOCK_EX)
            os.write(write, b'locked')
        except PermissionError:
            os.write(write, b'refused')
        signal.pause()
        os._exit(0)
    print(os.read(read, 10).decode(), flush=True)
    signal.alarm(5)
    if sys.argv[1] == 'stays':
        vpn.QUEUE = 0.2
        with vpn.locked(vpn.RECORDS):
            try:
                vpn.claim('fog0a1b2c', 0, os.getpid())
            except vpn.Refused as error:
                print(error)
    else:
        vpn.claim('fog0a1b2c', 0, os.getpid())
        print(*(record.name for record in vpn.records()))
except TimeoutError as error:
    print(error)
finally:
    os.kill(child, signal.SIGKILL)
    shutil.rmtree(top)
"""
#: Root makes a name a user's own; the launch ends, and another process gets its id, at last while
#: a request waits. Prints what the helper says to the requests that concern this process, and what
#: it does for them.
REUSED = LOADED + """\
top = Path(tempfile.mkdtemp(dir='/run'))
vpn.RECORDS = top / 'records'
vpn.prepare()
vpn.run = lambda commands: print('root acts on', launch.pid)
launch = subprocess.Popen(['sleep', '60'])


def end(network=''):
    launch.kill(), launch.wait()
    # all other ids come before it again, which takes longer than a tick of the start times
    ended = time.monotonic()
    while time.monotonic() - ended < 2 / os.sysconf('SC_CLK_TCK'):
        pass
    Path('/proc/sys/kernel/ns_last_pid').write_text(str(launch.pid - 1))
    other = subprocess.Popen(['sleep', '60'])
    assert other.pid == launch.pid
    return []


try:
    vpn.claim('fog0a1b2c', 0, launch.pid)
    request = {'name': 'fog0a1b2c', 'network': '198.18.7.0/24', 'address': '198.18.7.1',
               'port': 51820, 'domain': 0, 'ports': [], 'asked': [], 'peers': []}
    vpn.up(request, 0)
    end()
    for verb in 'up', 'peers', 'repair':
        try:
            vpn.VERBS[verb](request, 0)
        except vpn.Refused as error:
            print(error)
    launch = subprocess.Popen(['sleep', '60'])
    vpn.claim('fog0a1b2d', 0, launch.pid)
    vpn.taken = end
    try:
        vpn.up({**request, 'name': 'fog0a1b2d', 'network': '198.18.8.0/24',
                'address': '198.18.8.1'}, 0)
    except vpn.Refused as error:
        print(error)
finally:
    shutil.rmtree(top)
"""
#: The loopback interface for sockets of both address families.
FAMILIES = pytest.mark.parametrize('address', ['127.0.0.1', '::ffff:127.0.0.1'])
#: Opens so many connections to a port of the loopback, and counts those that the server closes.
MANY = """\
import socket
links = [socket.create_connection((sys.argv[2], int(sys.argv[1])))
         for _ in range(int(sys.argv[3]))]
closed = 0
for link in links:
    link.settimeout(60)
    try:
        closed += link.recv(1) == b''
    except ConnectionError:
        closed += 1
    except OSError:
        break
print(closed, flush=True)
sys.stdin.read()
"""
#: Asks a port of the loopback for a page, and says what it answered.
ASK = """\
import socket
link = socket.create_connection((sys.argv[2], int(sys.argv[1])), 10)
try:
    link.sendall(f'GET {sys.argv[3]} HTTP/1.0\\r\\n\\r\\n'.encode())
    print(link.recv(1000), flush=True)
except ConnectionError:
    print(b'', flush=True)
"""
#: Opens connections to a port and accepts them, up to a number or its limit.
CROWD = """\
import resource, socket
most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
listener = socket.create_server(('127.0.0.1', 0))
links = []
try:
    while len(links) < int(sys.argv[1]):
        links += [socket.create_connection(listener.getsockname()), listener.accept()[0]]
except OSError:
    links = links[:-10]
print(len(links), flush=True)
sys.stdin.read()
"""
#: Serves a page at a port of the loopback, which it prints.
SQUAT = """\
import socket
listener = socket.create_server(('127.0.0.1', 0))
print(listener.getsockname()[1], flush=True)
while True:
    link, _ = listener.accept()
    link.sendall(b'HTTP/1.1 200 OK\\r\\n\\r\\nof another account')
    link.close()
"""
#: Answers at a port of the loopback, which it prints, without end.
FLOOD = """\
import socket
listener = socket.create_server(('127.0.0.1', 0))
print(listener.getsockname()[1], flush=True)
while True:
    link, _ = listener.accept()
    try:
        link.sendall(b'HTTP/1.1 200 OK\\r\\nTransfer-Encoding: chunked\\r\\n\\r\\n')
        while True:
            link.sendall(b'1\\r\\nx\\r\\n')
    except OSError:
        pass
"""
#: Opens a connection, and closes its socket at once.
LEAVE = """\
import socket
link = socket.create_connection((sys.argv[2], int(sys.argv[1])), 10)
link.sendall(b'GET / HTTP/1.0\\r\\n\\r\\n')
link.close()
print('left', flush=True)
"""


class Said:
    """A program on a machine that says a line and ends."""

    def __init__(self) -> None:
        self.out = [b'from the machine\n']

    def recv(self, size: int) -> bytes:
        return self.out.pop() if self.out else b''

    def recv_stderr(self, size: int) -> bytes:
        return b''

    def recv_exit_status(self) -> int:
        return 7

    def sendall(self, data: bytes) -> None: ...
    def shutdown_write(self) -> None: ...
    def settimeout(self, timeout: float | None) -> None: ...
    def close(self) -> None: ...


def helper(lock: str) -> str:
    """Run the attack on the helper's folder as root, and return what it printed."""
    return process.run(Command((sys.executable, '-I', '-c', LOCKED, lock), sudo=True),
                       timeout=30.0, check=False).stdout


def test_no_account_locks_the_vpn_helper_s_folder(root: None) -> None:
    assert helper('goes').split() == ['refused', 'fog0a1b2c']


def test_the_vpn_helper_waits_for_a_lock_until_a_deadline(root: None) -> None:
    assert 'another process has held' in helper('stays')


def test_vpn_helper_knows_a_process_id_that_was_used_again(root: None) -> None:
    if not Path('/proc/sys/kernel/ns_last_pid').exists():
        pytest.skip('needs a kernel that lets root choose the next process id')
    said = process.run(Command((
        'unshare', '--pid', '--fork', '--mount-proc', sys.executable, '-I', '-c', REUSED),
        sudo=True), timeout=60.0).stdout
    first, *others = said.splitlines()
    assert first.startswith('root acts on') and len(others) == 4
    assert all(line.endswith('has ended') for line in others), said


def test_a_stopped_terminal_does_not_stop_the_vpn_helper(root: None) -> None:
    """A user's terminal sends SIGTSTP to root's programs too."""
    code = f"{LOADED}vpn.settle()\nos.kill(os.getpid(), signal.SIGTSTP)\nprint('goes on')"
    done = subprocess.run([sys.executable, '-I', '-c', code], capture_output=True, text=True,
                          timeout=60, preexec_fn=os.setpgrp)
    assert done.stdout == 'goes on\n', done.stderr


def test_no_account_can_connect_to_a_sync() -> None:
    """Its socket has no name; rsync's remote shell inherits it."""
    with relay.remote_shell(lambda line, *streams: relay.relay(Said(), *streams)) \
            as (variables, inherited, failures):
        # tests that run beside this one hold names of their own
        named = re.findall('@fogros2(?!-test-).*', Path('/proc/net/unix').read_text())
        assert named == []
        # as rsync starts it
        done = subprocess.run(
            [*shlex.split(relay.RSH), 'machine', 'rsync', '--server'], timeout=60,
            stdin=subprocess.DEVNULL, capture_output=True, pass_fds=inherited,
            env={**os.environ, **variables})
    assert (done.stdout, done.returncode, failures) == (b'from the machine\n', 7, [])


def test_no_account_takes_up_the_dashboard_s_threads(root: None) -> None:
    dashboard = Dashboard(None)  # type: ignore[arg-type]
    before = threading.active_count()
    with stranger(MANY, str(dashboard.server_port), '127.0.0.1', '20') as child:
        assert child.stdout and child.stdout.readline() == b'20\n'
        assert threading.active_count() == before
        with socket.create_connection(('127.0.0.1', dashboard.server_port)) as own:
            own.sendall(b'GET / HTTP/1.0\r\nHost: %b\r\n\r\n' % dashboard.hosts[0].encode())
            assert own.recv(100).startswith(b'HTTP/1.1 200 OK')
    dashboard.close()


def test_no_account_starts_programs_through_the_tunnel(root: None) -> None:
    shell = FakeShell(streams=[])
    made = Tunnel(shell, ('127.0.0.1', 9))
    with stranger(MANY, str(made.port), '127.0.0.1', '20') as child:
        assert child.stdout and child.stdout.readline() == b'20\n'
    assert shell.opened == []
    made.close()


@FAMILIES
def test_no_account_takes_up_the_gate_s_connections(root: None, address: str) -> None:
    async def knock() -> bytes:
        listener = socket.create_server(('127.0.0.1', 0))
        listener.setblocking(False)
        port = listener.getsockname()[1]
        serving = asyncio.ensure_future(Gate(('127.0.0.1', 9), 'token').serve(listener))
        with stranger(MANY, str(port), address, '150') as child:
            assert child.stdout
            closed = await asyncio.to_thread(child.stdout.readline)
            assert closed == b'150\n'
            reader, writer = await asyncio.open_connection('127.0.0.1', port)
            writer.write(b'GET / HTTP/1.1\r\nHost: localhost\r\n\r\n')
            answer = await reader.read(100)
            writer.close()
        serving.cancel()
        return answer

    assert loops.run(knock()).startswith(b'HTTP/1.1 401 ')


@pytest.mark.parametrize(('head', 'status'), [
    ('Cookie: {}={}', b'200 OK'), ('Upgrade: websocket', b'502 Bad Gateway')])
def test_no_account_stands_for_bridge_or_application(
    root: None, head: str, status: bytes,
) -> None:
    """It listens at their port before them."""
    async def look(port: int) -> bytes:
        listener = socket.create_server(('127.0.0.1', 0))
        listener.setblocking(False)
        gate = Gate(('127.0.0.1', port), 'token', ('127.0.0.1', port))
        serving = asyncio.ensure_future(gate.serve(listener))
        reader, writer = await asyncio.open_connection(*listener.getsockname())
        target = '/' if 'Cookie' in head else '/?token=token'
        line = head.format(*request.cookie('token'))
        writer.write(f'GET {target} HTTP/1.1\r\nHost: localhost\r\n{line}\r\n\r\n'.encode())
        answer = await reader.read()
        serving.cancel()
        return answer

    with stranger(SQUAT) as child:
        assert child.stdout
        answer = loops.run(look(int(child.stdout.readline())))
    assert answer.startswith(b'HTTP/1.1 ' + status) and b'of another account' not in answer


@pytest.mark.parametrize('theirs', [True, False])
def test_no_account_stands_for_the_bridge_on_the_robot(
    root: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str], theirs: bool,
) -> None:
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path))
    with stranger(SQUAT) as child, socket.create_server(('127.0.0.1', 0)) as own:
        assert child.stdout
        port = int(child.stdout.readline()) if theirs else own.getsockname()[1]
        folder = Path(addresses.folder_of(
            str(addresses.on_robot(Store(), 'planner')), port, addresses.of_process(1)))
        token = credentials.make_token(folder).token.read_text().strip()
        assert access.on_robot('planner') == (None if theirs else (port, token))
    # for localhost, a browser may try [::1] first, where another account may listen
    verbs.show_here('planner', port, token, browser=False)
    assert f' ws://127.0.0.1:{port}/' in capsys.readouterr().out


def test_no_account_takes_up_the_door_for_guests(
    root: None, tmp_path: Path,
) -> None:
    (tmp_path / 'guests').write_text('[]')
    door = Door(SimpleNamespace(state=tmp_path / 'guests'),  # type: ignore[arg-type]
                {'address': '127.0.0.1', 'port': 0, 'agent': __file__})
    threading.Thread(target=door.serve_forever, daemon=True).start()
    with stranger(MANY, str(door.server_address[1]), '127.0.0.1', '20') as child:
        assert child.stdout and child.stdout.readline() == b'20\n'
    door.shutdown()
    door.server_close()


def test_no_account_gets_the_page_of_a_browser(root: None) -> None:
    """Every account can read the ticket on the command line of the browser."""
    with contextlib.closing(Ticket('http://127.0.0.1:9/#token')) as ticket:
        place = urllib.parse.urlsplit(ticket.url)
        with stranger(ASK, str(place.port), '127.0.0.1', place.path) as child:
            assert child.stdout and child.stdout.readline() == b"b''\n"
        # the ticket is not used up either
        with contextlib.closing(http.client.HTTPConnection(place.netloc, timeout=60)) as own:
            own.request('GET', place.path)
            assert own.getresponse().getheader('Location') == 'http://127.0.0.1:9/#token'


def test_no_account_stands_for_the_daemon_of_ros2(root: None, tmp_path: Path) -> None:
    """It listens at the port that a launch has chosen for its daemon."""
    with stranger(FLOOD) as child:
        assert child.stdout
        (tmp_path / ros2_daemon.PORT_FILE).write_bytes(child.stdout.readline())
        in_thread(lambda: ros2_daemon.stop(tmp_path)).result(3.0)


def unowned(link: socket.socket) -> bool:
    """Return whether the kernel lists a client's socket without its account."""
    ports = [f':{name[1]:04X}' for name in (link.getpeername(), link.getsockname())]
    lines = [line.split() for table in ('tcp', 'tcp6')
             for line in Path('/proc/net', table).read_text().splitlines()[1:]]
    return ['0'] == [fields[7] for fields in lines
                     if all(map(str.endswith, fields[1:3], ports))]


@FAMILIES
def test_closed_socket_of_an_account_is_foreign(root: None, address: str) -> None:
    """The kernel lists a closed socket as root's."""
    with socket.create_server(('127.0.0.1', 0)) as listener:
        with stranger(LEAVE, str(listener.getsockname()[1]), address) as child:
            assert child.stdout and child.stdout.readline() == b'left\n'
        with listener.accept()[0] as link:
            wait_until(lambda: unowned(link), timeout=60.0, what='the last ACK')
            assert accounts.is_foreign(link)


@pytest.mark.parametrize(('peer', 'foreign'), [
    (('127.0.0.1', 1), True), (('127.3.2.1', 1), True), (('::1', 1, 0, 0), True),
    (('::ffff:127.0.0.1', 1, 0, 0), True), (('198.51.100.7', 1), False),
    (('::ffff:198.51.100.7', 1, 0, 0), False), (('2001:db8::7', 1, 0, 0), False)])
def test_unlisted_client_is_foreign_on_this_computer(
    peer: tuple[str, int], foreign: bool,
) -> None:
    """The gate serves computers of the VPN too, whose accounts are unknown here."""
    link = SimpleNamespace(getpeername=lambda: peer, getsockname=lambda: peer)
    assert accounts.is_foreign(link) == foreign  # type: ignore[arg-type]


@FAMILIES
def test_own_client_is_not_foreign(address: str) -> None:
    with socket.create_server(('127.0.0.1', 0)) as listener, \
            socket.create_connection((address, listener.getsockname()[1])), \
            listener.accept()[0] as link:
        assert not accounts.is_foreign(link)


def test_sockets_of_an_account_do_not_slow_the_check(root: None) -> None:
    """A server that checks each connection for 0.3 s has no time for its user."""
    with stranger(CROWD, '8000') as child, socket.create_server(('127.0.0.1', 0)) as listener:
        assert child.stdout
        opened = int(child.stdout.readline())
        if opened < 8000:
            pytest.skip(f'an account may open only {opened} sockets here')
        with socket.create_connection(listener.getsockname()), listener.accept()[0] as link:
            begin = time.process_time()
            assert not any(accounts.is_foreign(link) for _ in range(20))
            assert time.process_time() - begin < 0.5
