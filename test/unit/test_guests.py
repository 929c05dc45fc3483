# SPDX-License-Identifier: Apache-2.0
"""Which guests a machine's VPN has: pure decisions over a list and a time."""

from __future__ import annotations

from collections.abc import Sequence
import inspect
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from fogros2.errors import AuthenticationError
from fogros2.model import Command, Endpoint, VpnInterface
from fogros2.waiting import wait_until
from fogros2_features.guests import network
from fogros2_features.guests import program as guests
from fogros2_features.guests.program import Guest
from fogros2_features.guests.shell import GuestShell

KEY, OTHER = 'first=', 'second='


def asked(key: str = KEY, **changes: object) -> Guest:
    return {'key': key, 'label': 'robot2', 'seconds': 60.0, 'patience': 180.0, 'left': 3600.0,
            'secret': '5a' * 32, 'addresses': ['198.18.7.224', '198.18.7.225'], **changes}


def test_guests_get_the_free_addresses_in_turn() -> None:
    found = guests.admitted(guests.admitted([], asked(), 100.0), asked(OTHER), 100.0)
    assert [(guest['key'], guest['address'], guest['until']) for guest in found] == [
        (KEY, '198.18.7.224', 160.0), (OTHER, '198.18.7.225', 160.0)]
    with pytest.raises(SystemExit, match='2 guests'):
        guests.admitted(found, asked('third='), 100.0)


def test_second_invitation_keeps_address_and_replaces_secret() -> None:
    found = guests.admitted(guests.admitted([], asked(), 100.0), asked(OTHER), 100.0)
    guests.heard(found, {KEY: 1700000000}, 110.0)
    again = guests.admitted(found, asked(seconds=600.0, secret='b7' * 32), 120.0)
    assert again[1]['secret'] == 'b7' * 32
    assert [(guest['key'], guest['address'], guest['until'], guest['heard'])
            for guest in again] == [
        (OTHER, '198.18.7.225', 160.0, None), (KEY, '198.18.7.224', 720.0, 110.0)]


def test_expired_guest_stays_while_it_is_heard() -> None:
    found = guests.admitted([], asked(), 100.0)
    (guest,) = found
    assert guests.due(guest) == 160.0
    guests.heard(found, {KEY: 0}, 150.0)  # no handshake yet
    assert guests.due(guest) == 160.0
    guests.heard(found, {KEY: 1700000000}, 159.0)
    assert guests.due(guest) == 339.0
    guests.heard(found, {KEY: 1700000000}, 300.0)  # the same handshake as before
    assert guests.due(guest) == 339.0
    guests.heard(found, {KEY: 9}, 301.0)  # the clock was set back
    assert guests.due(guest) == 481.0


def test_guest_ends_with_the_lifetime_of_the_machine() -> None:
    found = guests.admitted([], asked(left=100.0), 100.0)
    guests.heard(found, {KEY: 1700000000}, 150.0)
    assert guests.due(found[0]) == 200.0
    assert guests.account('fogabc123m0', '198.18.7.224') == 'fogabc123m0g224'


def test_wg_reads_the_guests_until_the_next_look() -> None:
    found = guests.admitted([], asked(), 100.0)
    assert guests.rendered(found) == (
        '[Peer]\nPublicKey = first=\nAllowedIPs = 198.18.7.224/32')
    assert guests.again(found, 100.0) == 161 and guests.again(found, 200.0) == 211


def test_guests_have_the_end_of_the_subnet() -> None:
    assert str(network.guests('198.18.7.0/24')) == '198.18.7.224/27'
    interface = VpnInterface('fogabc123m0', '198.18.7.2', '198.18.7.0/24', 50000, '/run/key')
    text = network.rules(interface, [(7400, 7649), (7650, 7651)])
    assert 'iifname "fogabc123m0" ip saddr 198.18.7.224/27 goto guests' in text
    assert 'udp dport { 7400-7649, 7650-7651 } accept' in text


def test_list_is_private_and_replaces_no_file_of_others(tmp_path: Path) -> None:
    (tmp_path / 'other').write_text('')
    (tmp_path / 'fog.guests.new').symlink_to(tmp_path / 'other')
    path = tmp_path / 'fog.guests'
    guests.write(path, json.dumps([1]))
    assert path.read_text() == '[1]' and path.stat().st_mode & 0o777 == 0o600
    assert (tmp_path / 'other').read_text() == ''


def test_no_guest_locks_the_list(tmp_path: Path) -> None:
    found = guests.Guests('fogabc123m0', tmp_path)
    before = os.umask(0o022)
    try:
        with found.locked(), guests.lock_file(found.door):
            modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    finally:
        os.umask(before)
    assert modes == {'fogabc123m0.more.lock': 0o600, 'fogabc123m0.more.door': 0o600}


class Machine:
    """
    A machine with an interface whose guests have accounts, which are all it keeps.

    :ivar stuck: accounts that cannot be deleted, with the error.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.guests = guests.Guests('fogabc123m0', folder)
        self.ran: list[str] = []
        self.accounts: set[str] = set()
        self.stuck: dict[str, BaseException] = {}
        monkeypatch.setattr(guests, 'uptime', lambda: 100.0)
        monkeypatch.setattr(guests, 'evict', self.evict)
        monkeypatch.setattr(guests, 'subprocess', SimpleNamespace(
            run=self.run, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL,
            SubprocessError=subprocess.SubprocessError))

    def run(self, words: tuple[object, ...], **_: Any) -> Any:
        self.ran.append(' '.join(map(str, words)))
        return SimpleNamespace(stdout='')

    def evict(self, user: str) -> None:
        if user in self.stuck:
            raise self.stuck[user]
        self.accounts.discard(user)

    def change(self, verb: str, **request: Any) -> list[str]:
        """Run a request; return the keys of the guests that are there afterwards."""
        with self.guests.locked() as before:
            after = self.guests.change(before, verb, request)
        if verb == 'admit':
            self.accounts.update(guests.account('fogabc123m0', one['address']) for one in after)
        return [one['key'] for one in after]

    def admits(self, address: str) -> bool:
        door = guests.Door.__new__(guests.Door)
        door.guests = self.guests
        return door.admits(address, b'', None)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    found = Machine(tmp_path, monkeypatch)
    for key in (KEY, OTHER):
        found.change('admit', **asked(key, rules=''))
    assert len(found.accounts) == 2 and found.admits('198.18.7.225')
    return found


@pytest.mark.parametrize('verb', ['remove', 'clear'])
def test_next_look_goes_on_where_a_killed_one_ended(machine: Machine, verb: str) -> None:
    machine.stuck = {'fogabc123m0g225': KeyboardInterrupt()}
    with pytest.raises(KeyboardInterrupt), machine.guests.locked() as before:
        if verb == 'clear':
            machine.guests.clear(before)
        else:
            machine.guests.change(before, 'remove', {'keys': None})
    assert machine.accounts == {'fogabc123m0g225'} and not machine.admits('198.18.7.225')
    assert machine.guests.due.read_text() == '0\n', 'the health check looks at once'
    machine.stuck = {}
    assert machine.change('look') == [] and machine.accounts == set()
    assert json.loads(machine.guests.state.read_text()) == []
    assert not machine.guests.due.exists()
    assert machine.ran.count(f'wg set fogabc123m0 peer {OTHER} remove') >= 1


def test_guest_that_cannot_be_evicted_keeps_no_other_one(machine: Machine) -> None:
    machine.stuck = {'fogabc123m0g224': OSError('no memory')}
    with pytest.raises(OSError, match='is not deleted yet'):
        machine.change('remove', keys=[KEY, OTHER])
    assert machine.accounts == {'fogabc123m0g224'} and not machine.admits('198.18.7.224')
    assert machine.guests.due.read_text() == '111\n'
    with pytest.raises(OSError, match='is not deleted yet'):
        machine.change('admit', **asked('third=', rules=''))
    assert machine.admits('198.18.7.225') and not machine.admits('198.18.7.224')
    machine.stuck = {}
    assert machine.change('look') == ['third=']
    assert KEY not in machine.guests.state.read_text()


ENDS_ITS_FIRST_THREAD = """
import ctypes, threading
threading.Thread(target=threading.Event().wait).start()
ctypes.CDLL(None).syscall(60, 0)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason='root alone starts processes of another account')
@pytest.mark.parametrize('idle', [True, False])
def test_eviction_waits_for_no_process_of_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, idle: bool,
) -> None:
    def noted(words: Sequence[Any], **options: Any) -> subprocess.CompletedProcess[Any]:
        commands.append(words)
        return run(words, **options)

    run, commands = subprocess.run, list[Sequence[Any]]()
    monkeypatch.setattr(subprocess, 'run', noted)
    number = guests.new_id()
    monkeypatch.setattr(guests.pwd, 'getpwnam', lambda user: SimpleNamespace(
        pw_uid=number, pw_gid=number))
    monkeypatch.setattr(guests, 'HOMES', tmp_path / 'homes')
    monkeypatch.setattr(guests, 'CLEAN', ':')
    deep = tmp_path / 'homes/fogabc123m0g224'
    deep.mkdir(parents=True)
    for _ in range(100):
        deep /= 'd'
        deep.mkdir()
    child = subprocess.Popen([sys.executable, '-ISc', 'input()'], stdin=subprocess.PIPE,
                             **({} if idle else {'user': number}))
    try:
        assert guests.runs(number) != idle
        limit = sys.getrecursionlimit()
        sys.setrecursionlimit(len(inspect.stack()) + 60)
        try:
            guests.evict('fogabc123m0g224')
        finally:
            sys.setrecursionlimit(limit)
        assert any(guests.KILL in words for words in commands) != idle
        assert not guests.runs(number) and not (tmp_path / 'homes').exists()
        assert (child.poll() is None) == idle
    finally:
        child.kill()
        child.communicate()


#: Prints a line; sends a signal to all other processes of its account, again and again.
HOSTILE = """
import os, sys
print(flush=True)
while True:
    try:
        os.kill(-1, int(sys.argv[1]))
    except OSError:
        pass
"""


@pytest.mark.skipif(os.geteuid() != 0, reason='root alone starts processes of another account')
@pytest.mark.parametrize('sent', [signal.SIGSTOP, signal.SIGKILL])
def test_guest_holds_neither_its_door_nor_its_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sent: signal.Signals,
) -> None:
    def run() -> None:
        shells = [guests.Door.begin(door, link, 'guest') for _ in range(50)]
        guests.evict('guest')
        for shell in shells:
            shell.wait()

    number = guests.new_id()
    monkeypatch.setattr(guests.pwd, 'getpwnam', lambda user: SimpleNamespace(
        pw_uid=number, pw_gid=number))
    for name, value in (('HOMES', tmp_path), ('CLEAN', ':'), ('ENTRY', ':'),
                        ('confine', lambda *_: None)):
        monkeypatch.setattr(guests, name, value)
    (tmp_path / 'guest').mkdir()
    door: Any = SimpleNamespace(request={'shell': ''})
    ours, link = socket.socketpair()
    hostile = subprocess.Popen([sys.executable, '-ISc', HOSTILE, str(int(sent))], user=number,
                               group=number, extra_groups=(), stdout=subprocess.PIPE)
    try:
        assert hostile.stdout is not None and hostile.stdout.readline()
        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        thread.join(60.0)
        assert not thread.is_alive() and not guests.runs(number)
    finally:
        ours.close()
        link.close()
        hostile.kill()
        hostile.communicate()


@pytest.mark.skipif(os.geteuid() != 0 or os.uname().machine != 'x86_64',
                    reason='needs root and the numbers of system calls of x86-64')
def test_process_without_its_first_thread_runs() -> None:
    number = guests.new_id()
    child = subprocess.Popen([sys.executable, '-ISc', ENDS_ITS_FIRST_THREAD], user=number)
    try:
        status = Path(f'/proc/{child.pid}/status')
        wait_until(lambda: 'State:\tZ' in status.read_text(), timeout=60.0, what='its end')
        assert guests.runs(number)
    finally:
        child.kill()
        child.wait()
    assert not guests.runs(number)


@pytest.mark.parametrize('secret', [None, 'damaged'])
def test_machine_that_this_computer_has_left_refuses_commands(
    tmp_path: Path, secret: str | None,
) -> None:
    if secret is not None:
        (tmp_path / 'door.key').write_text(secret)
    shell = GuestShell(Endpoint('guest', '127.0.0.1', 9, 'a', key_file=str(tmp_path / 'door.key')),
                       name='planner')
    with pytest.raises(AuthenticationError, match="has left 'planner'"):
        shell.run(Command(('true',)), timeout=10.0)


def test_guest_that_leaves_is_no_peer_after_a_repair(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    """Its eviction failed; the repair of an interface asks for its peers."""
    monkeypatch.setenv('PATH', os.environ['PATH'])  # which the program extends
    machine.stuck = {'fogabc123m0g224': OSError('no memory')}
    with pytest.raises(OSError, match='is not deleted yet'):
        machine.change('remove', keys=[KEY])
    guests.main('fogabc123m0', 'peers', machine.guests.state.parent)
    peers = capsys.readouterr().out
    assert f'PublicKey = {OTHER}\n' in peers and KEY not in peers
