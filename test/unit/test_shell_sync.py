# SPDX-License-Identifier: Apache-2.0
"""Tests of what rsync is asked and of what it says; by value."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from pathlib import Path
import re
import shlex
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace

import paramiko
import pytest

from fogros2 import process
from fogros2.errors import Cancelled, CommandError, ConnectError, DeadlineExceeded, ShellError
from fogros2.model import Endpoint, Result
from fogros2.shell import multiplexed, multiplexer, relay, remote, sync
from fogros2.shell.local import LocalShell

PINNED = Endpoint('ssh', '198.51.100.7', 2222, 'fog', 'ssh-ed25519 AAAA', '/keys/my key')


@contextlib.contextmanager
def openssh(endpoint, folder, monkeypatch):
    """Yield what OpenSSH is called with for an endpoint, and the known hosts that it gets."""
    program = folder / 'ssh'
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    program.chmod(0o755)
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', f'{folder}:/usr/bin:/bin')
    with sync.open_ssh(endpoint) as (variables, inherited, failures):
        # as rsync starts it
        said = subprocess.run(
            [*shlex.split(relay.RSH), 'machine', 'rsync', '--server'], pass_fds=inherited,
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=10,
            env={**os.environ, **variables})
        words = said.stdout.splitlines()
        known, = (Path(w.partition('=')[2].strip('"').replace('%%', '%'))
                  for w in words if w.startswith('UserKnownHostsFile='))
        assert (said.returncode, failures) == (0, [])
        yield words, known
    assert not known.exists()


def test_openssh_is_pinned_as_we_are(tmp_path, monkeypatch):
    with openssh(PINNED, tmp_path, monkeypatch) as (words, known):
        for option in ('StrictHostKeyChecking=yes', 'BatchMode=yes', 'IdentitiesOnly=yes',
                       'GlobalKnownHostsFile=/dev/null', 'HostKeyAlias=machine'):
            assert option in words
        assert 'IdentityFile="/keys/my key"' in words
        assert words[-3:] == ['--', '198.51.100.7', 'rsync --server']
        assert known.read_text() == 'machine ssh-ed25519 AAAA\n'
        assert known.stat().st_mode & 0o077 == 0


def test_openssh_accepts_the_known_hosts_of_home(tmp_path, monkeypatch):
    # OpenSSH itself would read those of the account's home
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / '.ssh').mkdir()
    key = f'ecdsa-sha2-nistp256 {paramiko.ECDSAKey.generate().get_base64()}'
    (tmp_path / '.ssh/known_hosts').write_text(f'[host.example]:2222 {key}\n')
    endpoint = Endpoint('ssh', 'host.example', 2222, 'fog')
    with openssh(endpoint, tmp_path, monkeypatch) as (words, known):
        assert 'HostKeyAlias=machine' in words and 'StrictHostKeyChecking=yes' in words
        assert known.read_text() == f'machine {key}\n'


def test_progress_narrows_the_total_down():
    seen = []
    progress = sync.Progress(lambda done, total: seen.append((done, total)), interval=0.0)
    for line in ('sending incremental file list', '', '      1,024   0%    1.00MB/s    0:00:00',
                 '   2000000  20%  110.00MB/s    0:00:08', '   5100000  50%  110.00MB/s',
                 '  10000000 100%  110.00MB/s    0:00:00 (xfr#9, to-chk=0/10)'):
        progress(line)
    assert seen == [(2_000_000, 10_000_000), (5_100_000, 10_000_000), (10_000_000, 10_000_000)]


def test_progress_is_reported_now_and_then():
    seen = []
    progress = sync.Progress(lambda done, total: seen.append(done), interval=60.0)
    for percent in range(1, 101):
        progress(f'   {percent}000  {percent}%  1MB/s')
    assert seen == [1000, 100000]


def test_statistics_are_read():
    report = sync.report(
        'Number of files: 12 (reg: 10, dir: 2)\nNumber of regular files transferred: 3\n'
        'Total bytes sent: 1234567\nTotal bytes received: 88\n', 1.5)
    assert (report.files, report.bytes, report.seconds) == (3, 1_234_567, 1.5)


@pytest.mark.parametrize('code, stderr, kind, words', [
    (11, 'rsync: write failed: No space left on device (28)', ShellError, 'is full'),
    (127, 'rsync error: remote command not found (code 127)', ShellError, 'has no rsync'),
    (12, 'rsync: connection unexpectedly closed', ConnectError, 'was lost'),
    (255, 'ssh: Connection reset by peer', ConnectError, 'was lost'),
    (23, 'noise\nrsync: mkdir failed: Permission denied (13)', CommandError, 'right to write'),
    (23, 'rsync: opendir "/x" failed: odd (99)', CommandError, 'odd'),
])
def test_failures_are_explained(code, stderr, kind, words):
    error = sync.explained(Result(code, '', stderr), Path('/ws'), "'planner'")
    assert isinstance(error, kind)
    assert words in str(error)


@pytest.mark.parametrize('receiver, sender, side, words', [
    ("'planner'", 'this computer', 'sender', 'on this computer .* this user .* read it'),
    ("'planner'", 'this computer', 'receiver', "on 'planner' .* login user .* write there"),
    ('this computer', "'planner'", 'sender', "on 'planner' .* login user .* read it"),
    ('this computer', "'planner'", 'receiver', 'on this computer .* this user .* write there'),
])
def test_side_without_a_right_is_named(receiver, sender, side, words):
    result = Result(23, '', f'rsync: [{side}] open "/ws/a" failed: Permission denied (13)')
    error = sync.explained(result, Path('/ws'), receiver, sender)
    assert re.search(words, str(error))


def test_large_folders_are_told_from_small_ones(tmp_path):
    (tmp_path / 'a/.git').mkdir(parents=True)
    (tmp_path / 'a/.git/pack').write_bytes(b'x' * 5000)
    (tmp_path / 'a/file').write_bytes(b'x' * 1000)
    (tmp_path / 'loop').symlink_to('.')
    assert sync.is_large(tmp_path, 999)
    assert not sync.is_large(tmp_path, 1000)


class Here(remote.MultiplexedShell):
    """A shell by a multiplexer on this computer."""

    def __init__(self) -> None:
        super().__init__(Endpoint('guest'), name='here', timeout=10.0)
        ours, theirs = socket.socketpair()
        with theirs:
            self.child = subprocess.Popen([sys.executable, multiplexer.__file__],
                                          stdin=theirs, stdout=theirs)
        self.link = multiplexed.Link(ours, self.name, self.user)

    def _connect(
        self, timeout: float, cancel: threading.Event | None,
    ) -> multiplexed.Link:
        return self.link


@pytest.fixture
def shell():
    found = Here()
    yield found
    found.close()
    found.child.kill()
    found.child.wait()


def test_large_folders_go_both_ways(shell, tmp_path):
    """More than any buffer between: each end of rsync waits for the other."""
    for name in ('source', 'back'):
        (tmp_path / name).mkdir()
    for number in range(20):
        (tmp_path / f'source/{number}').write_bytes(os.urandom(300_000))
    there = str(tmp_path / 'there')
    assert shell.sync(tmp_path / 'source', there, excludes=[], timeout=60.0).files == 20
    shell.fetch(there, tmp_path / 'back', known=None, limit=1 << 30, timeout=60.0)
    assert (tmp_path / 'back/19').read_bytes() == (tmp_path / 'source/19').read_bytes()
    before = set(os.listdir('/proc/self/fd'))
    with pytest.raises(CommandError, match='No such file'):
        shell.fetch(f'{there}/nowhere', tmp_path / 'back', known=None, limit=1 << 30,
                    timeout=60.0)
    assert set(os.listdir('/proc/self/fd')) == before


def test_sync_takes_more_includes_than_a_command_line(shell, tmp_path):
    (tmp_path / 'source').mkdir()
    for name in 'ab':
        (tmp_path / 'source' / name).touch()
    shell.sync(tmp_path / 'source', str(tmp_path / 'there'), excludes=['/*'], timeout=60.0,
               includes=[*(f'/{number:0250}' for number in range(30_000)), '/b'])
    assert os.listdir(tmp_path / 'there') == ['b']


class Enough(threading.Event):
    """Is set when a folder has some bytes."""

    def __init__(self, folder: Path, enough: int) -> None:
        super().__init__()
        self.folder, self.enough = folder, enough

    def is_set(self) -> bool:
        return sync.size_on_disk(self.folder) >= self.enough


def test_fetch_continues_a_file_that_was_cut_off(shell, tmp_path, monkeypatch):
    (tmp_path / 'source').mkdir()
    (tmp_path / 'source/bag').write_bytes(os.urandom(8 << 20))
    run, outputs, more = process.run, [], ['--bwlimit=4M']

    def slow(command, **words):
        rsync, *others = command.argv
        command = dataclasses.replace(command, argv=(rsync, *more, *others))
        outputs.append(run(command, **words).stdout)
        return Result(0, '', '')

    monkeypatch.setattr(process, 'run', slow)
    fetch = functools.partial(shell.fetch, str(tmp_path / 'source'), tmp_path / 'back',
                              known=None, limit=1 << 30, timeout=60.0)
    with pytest.raises(Cancelled):
        fetch(cancel=Enough(tmp_path / 'back', 2 << 20))
    more[:] = ['--stats', '--no-human-readable']
    fetch()
    assert 0 < sync._number(outputs[-1], 'Total bytes received') < 7 << 20
    assert (tmp_path / 'back/bag').read_bytes() == (tmp_path / 'source/bag').read_bytes()


@pytest.mark.parametrize('copy', ['sync', 'fetch'])
def test_copy_without_progress_times_out(shell, tmp_path, monkeypatch, copy):
    (tmp_path / 'source').mkdir()
    monkeypatch.setattr(shell, 'run', lambda *_, **__: Result(0, '', ''))
    monkeypatch.setattr(relay, 'relay', lambda *_: threading.Event().wait(1.0) or 255)
    call = {'sync': functools.partial(shell.sync, tmp_path / 'source', 'there', excludes=()),
            'fetch': functools.partial(shell.fetch, str(tmp_path / 'source'), tmp_path / 'back',
                                       known=None, limit=1 << 30)}[copy]
    with pytest.raises(DeadlineExceeded, match='has copied too little in 0.3 s .check the robot'):
        call(timeout=0.3)


def test_copy_that_makes_progress_has_no_end(monkeypatch):
    now = 0.0
    monkeypatch.setattr(sync, 'time', SimpleNamespace(monotonic=lambda: now))
    stall = sync.Stall(None, 60.0)
    for minutes in range(600):
        now = minutes * 60.0
        assert not stall.is_set()
        stall.note(minutes)
    now += 61.0
    with pytest.raises(DeadlineExceeded):
        stall.is_set()


@pytest.mark.parametrize('folder, there', [
    ('/ws', '/ws/'), ('~/ws/src', 'ws/src/'), ('~/', './'),
])
def test_folders_begin_in_the_home(folder, there, monkeypatch):
    monkeypatch.setenv('HOME', '/home/robot')
    assert sync.place(folder, remote=True) == f'machine:{there}'
    here = sync.place(folder, remote=False)
    assert here.rstrip('/') == folder.replace('~', '/home/robot').rstrip('/')


def test_fetched_file_has_no_set_id_bits(tmp_path):
    """A machine's program would run as the robot's user for each account of the robot."""
    there = tmp_path / 'there'
    there.mkdir()
    (there / 'tool').write_text('#!/bin/sh\n')
    (there / 'tool').chmod(0o6755)
    LocalShell(Endpoint('local'), name='m').fetch(
        str(there), tmp_path / 'back', known=None, limit=1 << 20, timeout=60.0)
    assert (tmp_path / 'back/tool').stat().st_mode & 0o7777 == 0o755


def test_copy_that_is_too_large_at_its_end_is_refused(tmp_path, monkeypatch):
    """It may be over between two measurements."""
    there = tmp_path / 'there'
    there.mkdir()
    (there / 'large').write_bytes(os.urandom(100_000))
    monkeypatch.setattr(sync.Room, 'is_set', lambda room: False)
    with pytest.raises(ShellError, match='has sent more than'):
        LocalShell(Endpoint('local'), name='m').fetch(
            str(there), tmp_path / 'back', known=None, limit=50_000, timeout=60.0)
