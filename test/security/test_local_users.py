# SPDX-License-Identifier: Apache-2.0
"""
Another account of the robot's computer cannot stop what FogROS2 does for its users.

The account is ``nobody``: it owns nothing and belongs to no group.
"""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
import re
import shlex
import socket
import subprocess
import sys
import threading

from fogros2 import process
from fogros2.model import Command
from fogros2.shell import relay
from fogros2.testing.fakes import FakeShell
from fogros2_monitor.dashboard.server import Dashboard
from fogros2_monitor.gate import Gate
from fogros2_monitor.tunnel import Tunnel
from rigs import loops
from rigs.stranger import stranger

ROOT = Path(__file__).resolve().parents[2]
#: The helper's folder, as an older version left it or not there yet, is opened by another account
#: and locked; then root makes a name a user's own.
HELPER = """\
import importlib.util, os, shutil, signal, sys, tempfile
from pathlib import Path
import re
spec = importlib.util.spec_from_file_location('vpn_helper', sys.argv[1])
vpn = sys.modules['vpn_helper'] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(vpn)
top = Path(tempfile.mkdtemp(dir='/run'))
top.chmod(0o755)
def late(*_):
    raise TimeoutError('it waits for the lock')
signal.signal(signal.SIGALRM, late)
vpn.RECORDS = top / 'records'
if sys.argv[2] == 'older':
    vpn.RECORDS.mkdir(mode=0o755)
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
    if sys.argv[3] == 'stays':
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
#: Opens many connections to a port of the loopback, and counts those that the server closes.
MANY = """\
import socket
links = [socket.create_connection(('127.0.0.1', int(sys.argv[1]))) for _ in range(150)]
closed = 0
for link in links:
    link.settimeout(10)
    try:
        closed += link.recv(1) == b''
    except ConnectionError:
        closed += 1
    except OSError:
        break
print(closed, flush=True)
sys.stdin.read()
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


def helper(*words: str) -> str:
    """Run the attack on the helper's folder as root, and return what it printed."""
    return process.run(Command((
        sys.executable, '-I', '-c', HELPER, str(ROOT / 'packaging/vpn_helper/vpn.py'), *words),
        sudo=True), timeout=30.0, check=False).stdout


def test_no_account_locks_the_vpn_helper_s_folder(root: None) -> None:
    for state in ('new', 'older'):
        assert helper(state, 'goes').split() == ['refused', 'fog0a1b2c'], state


def test_the_vpn_helper_waits_for_a_lock_until_a_deadline(root: None) -> None:
    assert 'another process has held' in helper('new', 'stays')


def test_a_stopped_terminal_does_not_stop_the_vpn_helper(root: None) -> None:
    """A user's terminal sends SIGTSTP to root's programs too."""
    code = ('import importlib.util, os, signal, sys\n'
            'spec = importlib.util.spec_from_file_location("vpn_helper", sys.argv[1])\n'
            'vpn = sys.modules["vpn_helper"] = importlib.util.module_from_spec(spec)\n'
            'spec.loader.exec_module(vpn)\n'
            'vpn.settle()\n'
            'os.kill(os.getpid(), signal.SIGTSTP)\n'
            'print("goes on")')
    done = subprocess.run(
        [sys.executable, '-I', '-c', code, str(ROOT / 'packaging/vpn_helper/vpn.py')],
        capture_output=True, text=True, timeout=10, preexec_fn=os.setpgrp)
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
            [*shlex.split(relay.RSH), 'machine', 'rsync', '--server'], timeout=10,
            stdin=subprocess.DEVNULL, capture_output=True, pass_fds=inherited,
            env={**os.environ, **variables})
    assert (done.stdout, done.returncode, failures) == (b'from the machine\n', 7, [])


def test_no_account_takes_up_the_dashboard_s_threads(root: None) -> None:
    dashboard = Dashboard(None)  # type: ignore[arg-type]
    threading.Thread(target=dashboard.serve, daemon=True).start()
    before = threading.active_count()
    with stranger(MANY, str(dashboard.port)) as child:
        assert child.stdout and child.stdout.readline() == b'150\n'
        assert threading.active_count() == before
        with socket.create_connection(('127.0.0.1', dashboard.port)) as own:
            own.sendall(b'GET / HTTP/1.0\r\nHost: %b\r\n\r\n' % dashboard.hosts[0].encode())
            assert own.recv(100).startswith(b'HTTP/1.1 200 OK')
    dashboard.close()


def test_no_account_starts_programs_through_the_tunnel(root: None) -> None:
    shell = FakeShell(streams=[])
    made = Tunnel(shell, ('127.0.0.1', 9))
    threading.Thread(target=made.serve, daemon=True).start()
    with stranger(MANY, str(made.port)) as child:
        assert child.stdout and child.stdout.readline() == b'150\n'
    assert shell.opened == []
    made.close()


def test_no_account_takes_up_the_gate_s_connections(root: None) -> None:
    async def knock() -> bytes:
        listener = socket.create_server(('127.0.0.1', 0))
        listener.setblocking(False)
        port = listener.getsockname()[1]
        serving = asyncio.ensure_future(Gate(('127.0.0.1', 9), 'token').serve(listener))
        with stranger(MANY, str(port)) as child:
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
