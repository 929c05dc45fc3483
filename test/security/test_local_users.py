# SPDX-License-Identifier: Apache-2.0
"""
Another account of the robot's computer cannot stop what FogROS2 does for its users.

The account is ``nobody``: it owns nothing and belongs to no group.
"""

from __future__ import annotations

import os
from pathlib import Path
import shlex
import subprocess
import sys

from fogros2 import process
from fogros2.model import Command
from fogros2.shell import relay
from rigs.stranger import stranger

ROOT = Path(__file__).resolve().parents[2]
#: The helper's folder, as an older version left it or not there yet, is opened by another account
#: and locked; then root makes a name a user's own.
HELPER = """\
import importlib.util, os, shutil, signal, sys, tempfile
from pathlib import Path
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
#: Connects to the abstract sockets of relays before rsync does, and holds the connections.
FIRST = """\
import socket
links = []
for line in sys.stdin:
    links.append(socket.socket(socket.AF_UNIX))
    links[-1].connect('\\0' + line.strip())
    print('connected', flush=True)
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


def test_an_account_that_connects_first_stops_no_sync(root: None) -> None:
    with stranger(FIRST) as child, relay.remote_shell(lambda line: Said()) as (rsh, failures):
        assert child.stdin and child.stdout
        for _ in range(3):
            child.stdin.write(rsh.split()[-1].encode() + b'\n')
            child.stdin.flush()
            assert child.stdout.readline() == b'connected\n'
        # as rsync starts it
        done = subprocess.run([*shlex.split(rsh), 'machine', 'rsync', '--server'], timeout=10,
                              stdin=subprocess.DEVNULL, capture_output=True)
    assert (done.stdout, done.returncode, failures) == (b'from the machine\n', 7, [])
