# SPDX-License-Identifier: Apache-2.0
"""Tests of the SSH shell against a real server."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
import grp
import os
from pathlib import Path
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time

import pytest

from fogros2 import process
from fogros2.errors import (
    AuthenticationError,
    Cancelled,
    CommandError,
    ConnectError,
    DeadlineExceeded,
    HostKeyError,
    PrerequisiteError,
    ShellError,
)
from fogros2.model import Command, Endpoint
from fogros2.shell import host_key, lines, relay, sync
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import in_thread, Periodic, wait_until
from fogros2_testing import ShellContract
from rigs.sshd import free_port, private_sshd, PrivateSshd

pytestmark = pytest.mark.skipif(
    process.which('sshd') is None, reason='needs sshd (openssh-server)')


@pytest.fixture(scope='module')
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrivateSshd]:
    with private_sshd(tmp_path_factory.mktemp('server') / 'sshd') as running:
        yield running


@pytest.fixture(scope='module')
def shell(server: PrivateSshd) -> Iterator[SSHShell]:
    with contextlib.closing(SSHShell(server.endpoint, name='planner', timeout=60.0)) as opened:
        yield opened


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Return a home without keys or known hosts, and no agent."""
    monkeypatch.setenv('HOME', str(tmp_path / 'home'))
    monkeypatch.delenv('SSH_AUTH_SOCK', raising=False)
    (tmp_path / 'home/.ssh').mkdir(parents=True, mode=0o700)
    return tmp_path / 'home'


def made_key(path: Path, kind: str = 'ed25519', passphrase: str = '') -> Path:
    bits = ('-b', '2048') if kind == 'rsa' else ()
    process.run(Command(('ssh-keygen', '-q', '-t', kind, *bits, '-N', passphrase,
                         '-f', str(path))), timeout=60.0)
    return path


class TestSSHShell(ShellContract):

    sudo = os.geteuid() == 0 or process.run(
        Command(('sudo', '-n', 'true')), timeout=60.0, check=False).returncode == 0

    @pytest.fixture
    def connection(self, shell, tmp_path):
        (tmp_path / 'there').mkdir()
        return shell, str(tmp_path / 'there')


@pytest.mark.parametrize('kind', ['ed25519', 'ecdsa'])
def test_another_host_key_than_the_pinned_one_is_refused(server, tmp_path, kind):
    pinned = dataclasses.replace(server.endpoint, host_key=made_key(
        tmp_path / 'other', kind).with_suffix('.pub').read_text())
    with pytest.raises(HostKeyError, match='another host key' if kind == 'ed25519' else ''):
        SSHShell(pinned, name='planner').run(Command(('true',)), timeout=60.0)


def test_unknown_or_changed_host_is_refused_with_the_remedy(server, home):
    shell = SSHShell(dataclasses.replace(server.endpoint, host_key=None), name='planner')
    with pytest.raises(HostKeyError, match='unknown') as refused:
        shell.run(Command(('true',)), timeout=60.0)
    line = refused.value.hint.partition('known_hosts: ')[2]
    assert line == f'[127.0.0.1]:{server.port} {server.host_key}'
    (home / '.ssh/known_hosts').write_text(f'{line}\n')
    assert shell.run(Command(('true',)), timeout=60.0).returncode == 0
    shell.close()
    other = 'AAAAC3NzaC1lZDI1NTE5AAAAINhr1xZ0GZJ4Mqbso1vdFbxmsNCtINbcVrdTGUPNy8U9'
    (home / '.ssh/known_hosts').write_text(
        f'[127.0.0.1]:{server.port} ssh-ed25519 {other}\n')
    with pytest.raises(HostKeyError, match=r'ssh-keygen -R') as refused:
        shell.run(Command(('true',)), timeout=60.0)
    assert f"'[127.0.0.1]:{server.port}'" in refused.value.hint


def test_useless_keys_are_named(server, tmp_path):
    (tmp_path / 'text').write_text('no key')
    for path, words in ((made_key(tmp_path / 'stranger'), 'does not accept .*authorized_keys'),
                        (made_key(tmp_path / 'locked', passphrase='secret'), 'ssh-add'),
                        (tmp_path / 'missing', 'can not be read'),
                        (tmp_path / 'text', 'no private key')):
        endpoint = dataclasses.replace(server.endpoint, key_file=str(path))
        with pytest.raises(AuthenticationError, match=words) as refused:
            SSHShell(endpoint, name='planner').run(Command(('true',)), timeout=60.0)
        assert str(path) in str(refused.value)


@pytest.mark.parametrize('pkcs8', [False, True], ids=['', 'of OpenSSL'])
@pytest.mark.parametrize('kind', ['ecdsa', 'rsa'])
def test_keys_of_every_type_log_in(server, tmp_path, kind, pkcs8):
    path = made_key(tmp_path / 'own', kind)
    if pkcs8:
        process.run(Command(('ssh-keygen', '-q', '-p', '-m', 'PKCS8', '-N', '', '-f', str(path))),
                    timeout=60.0)
        assert path.read_text().startswith('-----BEGIN PRIVATE KEY')
    with open(server.folder / 'authorized_keys', 'a') as keys:
        keys.write(path.with_suffix('.pub').read_text())
    endpoint = dataclasses.replace(server.endpoint, key_file=str(path))
    with contextlib.closing(SSHShell(endpoint, name='planner')) as shell:
        assert shell.run(Command(('true',)), timeout=60.0).returncode == 0


def test_the_user_s_own_keys_are_tried(server, home):
    endpoint = dataclasses.replace(server.endpoint, key_file=None)
    with pytest.raises(AuthenticationError, match='no key to log in'):
        SSHShell(endpoint, name='planner').run(Command(('true',)), timeout=60.0)
    (home / '.ssh/id_ed25519').write_text((server.folder / 'id').read_text())
    (home / '.ssh/id_ed25519').chmod(0o600)
    with contextlib.closing(SSHShell(endpoint, name='planner')) as shell:
        assert shell.run(Command(('true',)), timeout=60.0).returncode == 0


@pytest.mark.parametrize(('host', 'words'), [
    ('127.0.0.1', 'refuses connections'), ('no-such-host.invalid', 'no-such-host.invalid')])
def test_host_without_a_server_is_named_at_once(host, words):
    shell = SSHShell(Endpoint('ssh', host, free_port(), 'fog', 'ssh-ed25519 AAAA'),
                     name='planner', timeout=60.0)
    begin = time.monotonic()
    with pytest.raises(ConnectError, match=words):
        shell.run(Command(('true',)), timeout=60.0)
    assert time.monotonic() - begin < 30.0


@pytest.mark.parametrize('greeting', [b'', b'HTTP/1.1 400 Bad Request\r\n\r\n'])
def test_server_of_another_kind_is_refused(greeting, capfd):
    with socket.create_server(('127.0.0.1', 0)) as listener:
        def serve() -> None:
            with contextlib.suppress(OSError):
                peer, _ = listener.accept()
                peer.sendall(greeting)
                peer.close()

        thread = threading.Thread(target=serve)
        thread.start()
        port = listener.getsockname()[1]
        shell = SSHShell(Endpoint('ssh', '127.0.0.1', port, 'fog', 'ssh-ed25519 AAAA'),
                         name='planner', timeout=30.0)
        with pytest.raises(ConnectError, match='does not answer as an SSH server'):
            shell.run(Command(('true',)), timeout=60.0)
        thread.join(60.0)
    assert capfd.readouterr().err == ''


def test_a_lost_connection_is_opened_again(server, shell):
    shell.run(Command(('true',)), timeout=60.0)
    server.cut()
    assert shell.run(Command(('echo', 'again')), timeout=60.0).stdout == 'again\n'
    server.stop()
    with pytest.raises(ConnectError, match='refuses connections'):
        shell.run(Command(('true',)), timeout=60.0)
    server.start()
    assert shell.run(Command(('true',)), timeout=60.0).returncode == 0


def test_lost_connection_ends_its_command_and_stream(server, shell, tmp_path):
    stream = shell.open(Command(('cat',)))
    stream.write(b'hello\n')
    assert stream.readline() == b'hello\n'
    started = tmp_path / 'started'
    running = in_thread(lambda: shell.run(
        Command.script(f'touch {started}; exec sleep 60', what='a long one'), timeout=30.0))
    wait_until(started.exists, timeout=60.0, what='the command to run')
    server.cut()
    with pytest.raises(ConnectError, match='lost while a long one ran'):
        running.result(60.0)
    assert stream.readline() == b''
    with pytest.raises(ConnectError):
        wait_until(lambda: stream.write(b'more\n'), timeout=60.0, what='the loss to be noticed')


def test_a_command_given_up_ends_there(server, shell):
    with pytest.raises(DeadlineExceeded):
        shell.run(Command(('sleep', '4711.25')), timeout=0.2)
    wait_until(lambda: '4711.25' not in process.run(
        Command(('ps', '-eo', 'args')), timeout=60.0).stdout.replace('ps -eo args', ''),
        timeout=60.0, what='the command to end')


def test_a_flood_on_standard_error_blocks_nothing(shell):
    result = shell.run(Command.script('head -c 9000000 /dev/zero >&2; echo done'), timeout=60.0)
    assert result.stdout == 'done\n'
    note, _, kept = result.stderr.partition('\n')
    assert int(note.removeprefix('[').split()[0]) + len(kept) == 9_000_000
    assert lines.KEPT <= len(kept) <= lines.KEPT + lines.MAX_LINE


def test_a_flood_on_a_stream_s_standard_error_blocks_nothing(shell):
    stream = shell.open(Command.script(
        'for i in 1 2 3 4 5 6 7 8; do head -c 1000000 /dev/zero >&2; echo $i; done'))
    assert [stream.readline() for _ in range(8)] == [b'%d\n' % (n + 1) for n in range(8)]
    stream.close()


def test_a_command_that_leaves_a_daemon_behind_returns(shell):
    begin = time.monotonic()
    result = shell.run(Command.script('sleep 90 & echo $!'), timeout=60.0)
    assert time.monotonic() - begin < 60.0
    shell.run(Command(('kill', result.stdout.strip())), timeout=60.0)


def test_a_command_that_reads_nothing_takes_much_input(shell):
    result = shell.run(Command(('sh', '-c', 'kill -KILL $$'), input=b'x' * 5_000_000),
                       timeout=30.0, check=False)
    # a signal has ended it
    assert result.returncode != 0


def test_few_sessions_are_waited_for(tmp_path):
    with private_sshd(tmp_path / 'sshd', 'MaxSessions 2\n') as server, \
            contextlib.closing(SSHShell(server.endpoint, name='planner')) as shell:
        calls = [in_thread(lambda: shell.run(Command(('sleep', '0.1')), timeout=30.0))
                 for _ in range(6)]
        assert [call.result(60.0).returncode for call in calls] == [0] * 6


def test_one_connection_serves_many_threads(server, shell):
    """A message for a channel that has ended makes the server close the whole connection."""
    def run() -> None:
        for _ in range(25):
            shell.run(Command(('true',)), timeout=30.0)

    shell.run(Command(('true',)), timeout=30.0)
    first = shell._connection
    for call in [in_thread(run) for _ in range(8)]:
        call.result(60.0)
    peers = process.run(Command(('ss', '-Htn', 'state', 'established', 'dport', '=',
                                 f':{server.port}')), timeout=60.0).stdout.splitlines()
    assert len(peers) == 1
    assert shell._connection is first


_INTERACTIVE = """
import sys
from fogros2.model import Command, Endpoint
from fogros2.shell.ssh import SSHShell
shell = SSHShell(Endpoint('ssh', '127.0.0.1', {port}, {user!r}, {host_key!r}, {key!r}),
                 name='planner', timeout=60.0)
sys.exit(shell.interactive({command}))
"""


def interactive(server: PrivateSshd, command: str) -> list[str]:
    endpoint = server.endpoint
    code = _INTERACTIVE.format(
        port=endpoint.port, user=endpoint.user, host_key=endpoint.host_key,
        key=endpoint.key_file, command=command)
    return [sys.executable, '-c', code]


def read_until(terminal: int, text: bytes) -> bytes:
    """Return a terminal's output up to ``text``."""
    got = b''
    os.set_blocking(terminal, False)

    def more() -> bool:
        nonlocal got
        with contextlib.suppress(BlockingIOError):
            got += os.read(terminal, 4096)
        return text in got

    wait_until(more, timeout=60.0, what=f'{text!r} on the terminal')
    return got


@pytest.fixture
def terminals(server):
    """Skip where sshd without root can't give a terminal away: it isn't its group's already."""
    ours, theirs = os.openpty()
    group = os.fstat(theirs).st_gid
    os.close(ours)
    os.close(theirs)
    if os.geteuid() != 0 and group != grp.getgrnam('tty').gr_gid:
        pytest.skip("needs root, or /dev/pts mounted with tty's group as distributions do")


#: Prints the terminal's size, the other size when it has come, and exits with 7 after a line.
RESIZED = """\
stty size
until stty size | grep '44 111'; do sleep 0.05; done
read x
[ "$x" = go ] && exit 7
"""


def test_a_terminal_is_given_with_its_size_and_keys(server, terminals):
    ours, theirs = os.openpty()
    try:
        termios.tcsetwinsize(ours, (33, 99))
        child = subprocess.Popen(
            interactive(server, f"Command(('sh', '-c', {RESIZED!r}))"),
            stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
            preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)))
        read_until(ours, b'33 99\r\n')
        termios.tcsetwinsize(ours, (44, 111))
        wait_until(lambda: termios.tcgetwinsize(theirs) == (44, 111), timeout=60.0, what='resize')
        read_until(ours, b'44 111\r\n')
        os.write(ours, b'go\r')
        assert child.wait(60.0) == 7
        # cooked again
        assert termios.tcgetattr(theirs)[3] & termios.ICANON
    finally:
        os.close(ours)
        os.close(theirs)


def test_a_login_shell_is_given(server, terminals):
    ours, theirs = os.openpty()
    try:
        child = subprocess.Popen(interactive(server, ''), stdin=theirs, stdout=theirs,
                                 stderr=theirs, start_new_session=True)
        os.write(ours, b'unset HISTFILE; echo $((6 * 7)); exit 3\r')
        read_until(ours, b'42\r\n')
        assert child.wait(60.0) == 3
    finally:
        os.close(ours)
        os.close(theirs)


def test_without_a_terminal_bytes_go_as_they_are(server):
    data = bytes(range(256)) * 5000
    child = subprocess.run(
        interactive(server, "Command(('sh', '-c', 'cat; echo no >&2; exit 5'))"), input=data,
        capture_output=True, timeout=60, check=False)
    assert (child.returncode, child.stderr) == (5, b'no\n')
    assert child.stdout == data


def test_silent_machine_takes_no_longer_than_the_time_out(server, shell):
    shell.run(Command(('true',)), timeout=60.0)
    sessions = server.sessions()
    for pid in sessions:
        os.kill(pid, signal.SIGSTOP)
    listener = server.child
    assert listener is not None
    os.kill(listener.pid, signal.SIGSTOP)
    try:
        begin = time.monotonic()
        with pytest.raises((ConnectError, DeadlineExceeded)):
            shell.run(Command(('true',)), timeout=0.5)
        assert time.monotonic() - begin < 30.0
    finally:
        for pid in (*sessions, listener.pid):
            os.kill(pid, signal.SIGCONT)
    # the silent connection was given up for a new one
    assert shell.run(Command(('echo', 'back')), timeout=60.0).stdout == 'back\n'


# -- host keys that were sent to the machine ------------------------------------------------------

NEEDS_ROOT = pytest.mark.skipif(
    os.geteuid() != 0, reason="the server of this test is its user's, not root's")


def shown(server, key):
    """Return whether the server shows a key now; it may be reading it."""
    shell = SSHShell(dataclasses.replace(server.endpoint, host_key=key), name='it', timeout=60)
    try:
        shell.run(Command(('true',)), timeout=60)
        return True
    except (HostKeyError, ConnectError):
        return False
    finally:
        shell.close()


@NEEDS_ROOT
def test_a_server_gets_a_new_key_and_connections_go_on(root, tmp_path):
    folder = tmp_path / 'sshd'
    with private_sshd(folder, f'HostKey {made_key(tmp_path / "other", "ecdsa")}\n') as server:
        before = server.host_key
        shell = SSHShell(server.endpoint, name='it', timeout=60)
        stream = shell.open(Command(('cat',)))
        stream.write(b'one\n')
        assert stream.readline() == b'one\n'
        key = host_key.parse(shell.run(host_key.renew(), timeout=60).stdout)
        assert key == server.host_key != before
        assert (folder / 'host_key').stat().st_mode & 0o777 == 0o600
        assert sorted(path.name for path in folder.glob('host_key*')) == [
            'host_key', 'host_key.pub']
        wait_until(lambda: shown(server, key), timeout=60, what='the new key')
        assert not shown(server, before)
        stream.write(b'two\n')
        assert stream.readline() == b'two\n'
        shell.close()


@NEEDS_ROOT
def test_server_without_the_key_type_is_reported(root, tmp_path):
    with private_sshd(tmp_path / 'sshd') as server:
        shell = SSHShell(server.endpoint, name='it', timeout=60)
        shell.run(Command(('true',)), timeout=60)
        # its own are gone, and this computer's aren't a test's to replace
        command = host_key.renew()
        script = command.argv[-1].replace('/etc/ssh/', f'{tmp_path}/')
        for path in (tmp_path / 'sshd').glob('host_key*'):
            path.unlink()
        with pytest.raises(CommandError, match='no Ed25519 host key'):
            shell.run(Command.script(script, sudo=True), timeout=20)
        shell.close()


# -- sync: both transports, and what can go wrong -------------------------------------------------

@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / 'source'
    for number in range(200):
        path = folder / f'{number % 10}' / f'{number}'
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(os.urandom(5000))
    return folder


def compare(source: Path, target: Path) -> str:
    return process.run(Command(('diff', '-r', str(source), str(target))), timeout=30.0,
                       check=False).stdout


def rsyncs() -> list[str]:
    """Return the rsync processes of this computer that have to do with these tests."""
    lines = process.run(Command(('ps', '-eo', 'args')), timeout=60.0).stdout.splitlines()
    return [line for line in lines if 'rsync' in line and 'sync-target' in line]


def test_large_folder_goes_by_openssh_and_a_change_does_not(
    shell, source, tmp_path, monkeypatch,
):
    monkeypatch.setattr(sync, 'BULK', 1000)
    target = tmp_path / 'sync-target'
    with monkeypatch.context() as patch:
        patch.delattr(relay, 'relay')
        report = shell.sync(source, str(target), excludes=[], timeout=60.0)
    assert report.files == 200
    assert report.bytes > 1_000_000
    assert not compare(source, target)
    monkeypatch.delattr(sync, 'open_ssh')
    (source / '3/3').write_text('changed')
    report = shell.sync(source, str(target), excludes=[], timeout=60.0)
    assert report.files == 1
    assert report.bytes < 20_000
    assert not compare(source, target)


def test_openssh_finds_its_files_in_odd_folders(server, source, tmp_path, monkeypatch):
    odd = tmp_path / "Max' 100%zz #1"
    odd.mkdir()
    key = shutil.copy2(server.folder / 'id', odd)
    monkeypatch.setattr(sync, 'BULK', 1000)
    monkeypatch.delattr(relay, 'relay')
    monkeypatch.setattr(tempfile, 'tempdir', str(odd))
    endpoint = dataclasses.replace(server.endpoint, key_file=str(key))
    with contextlib.closing(SSHShell(endpoint, name='planner', timeout=60.0)) as shell:
        report = shell.sync(source, str(tmp_path / 'sync-target'), excludes=[], timeout=60.0)
    assert report.files == 200


def test_file_written_twice_in_a_second_is_sent_twice(shell, source, tmp_path):
    """Its size is the same: only the nanoseconds of its time tell."""
    target, copy = tmp_path / 'sync-target', tmp_path / 'copy'
    for text in ('rate: 10', 'rate: 20'):
        (source / 'rate').write_text(text)
        os.utime(source / 'rate', ns=(10 ** 18, 10 ** 18 + int(text[-2:])))
        shell.sync(source, str(target), excludes=(), timeout=30)
        assert (target / 'rate').read_text() == text
        known, copy = copy if copy.exists() else None, tmp_path / text
        shell.fetch(str(source), copy, known=known, limit=1 << 30, timeout=30)
        assert (copy / 'rate').read_text() == text


def test_links_modes_and_odd_names_arrive(shell, tmp_path):
    source = tmp_path / 'the source'
    (source / 'a b').mkdir(parents=True)
    (source / "a b/it's").write_text('x')
    (source / 'run').write_text('#!/bin/sh')
    (source / 'run').chmod(0o751)
    (source / 'link').symlink_to('run')
    (source / 'new\nline').write_text('y')
    (source / '-n').write_text('z')
    target = tmp_path / "sync-target $HOME `id` 'x'"
    shell.sync(source, str(target), excludes=[], timeout=60.0)
    assert not compare(source, target)
    assert (target / 'run').stat().st_mode & 0o777 == 0o751
    assert os.readlink(target / 'link') == 'run'


def test_machine_without_rsync_is_reported(source, tmp_path):
    programs = tmp_path / 'bin'
    programs.mkdir()
    for name in ('sh', 'bash', 'mkdir', 'ls', 'head', 'env'):
        (programs / name).symlink_to(process.which(name))
    with private_sshd(tmp_path / 'sshd', f'SetEnv PATH={programs} SHLVL=2\n') as server, \
            contextlib.closing(SSHShell(server.endpoint, name='planner')) as shell:
        with pytest.raises(ShellError, match="'planner' has no rsync .*apt-get install rsync"):
            shell.sync(source, str(tmp_path / 'sync-target'), excludes=[], timeout=60.0)


def test_robot_without_rsync_is_reported(shell, source, tmp_path, monkeypatch):
    real = process.which
    monkeypatch.setattr(process, 'which', lambda p: None if p == 'rsync' else real(p))
    with pytest.raises(PrerequisiteError, match='rsync not found on this computer'):
        shell.sync(source, str(tmp_path / 'sync-target'), excludes=[], timeout=60.0)


def test_full_disk_is_named(shell, tmp_path, root):
    """Tests that the machine's full disk has its own error."""
    disk = tmp_path / 'sync-target'
    disk.mkdir()
    (tmp_path / 'source').mkdir()
    (tmp_path / 'source/big').write_bytes(os.urandom(3 << 20))
    if process.run(Command(('mount', '-t', 'tmpfs', '-o', 'size=1m,mode=777', 'tmpfs', str(disk)),
                           sudo=True), timeout=60.0, check=False).returncode != 0:
        pytest.skip('needs the right to mount a file system')
    try:
        with pytest.raises(ShellError, match="disk of 'planner' is full"):
            shell.sync(tmp_path / 'source', f'{disk}/here', excludes=[], timeout=60.0)
        with pytest.raises(CommandError, match="disk of 'planner' is full"):
            shell.put(os.urandom(2 << 20), f'{disk}/there', mode=0o600)
    finally:
        process.run(Command(('umount', str(disk)), sudo=True), timeout=60.0)


def test_a_folder_that_can_t_be_made_is_named(shell, source):
    with pytest.raises(CommandError, match='making /proc/sync-target/x failed'):
        shell.sync(source, '/proc/sync-target/x', excludes=[], timeout=60.0)


def test_a_lost_connection_under_sync_is_an_error(server, shell, tmp_path, monkeypatch):
    monkeypatch.setattr(sync, 'BULK', 1 << 40)
    # a second's work would be over before a busy computer cuts the connection
    source = sized(tmp_path / 'source', 16 << 30)
    cuts = iter([server.cut])
    with pytest.raises(ConnectError):
        shell.sync(source, str(tmp_path / 'sync-target'), excludes=[], timeout=60.0,
                   on_progress=lambda done, total: next(cuts, lambda: None)())
    wait_until(lambda: not rsyncs(), timeout=60.0, what='rsync to end')


@pytest.mark.parametrize('bulk', [True, False])
def test_sync_can_be_cancelled(shell, tmp_path, monkeypatch, bulk):
    monkeypatch.setattr(sync, 'BULK', 1000 if bulk else 1 << 40)
    source, target = sized(tmp_path / 'source', 16 << 30), tmp_path / 'sync-target'
    cancel = threading.Event()
    # rsync writes under another name
    Periodic('a cancel', 0.02, lambda: cancel.set() if [*target.glob('.big.*')] else None,
             stop=cancel)
    with pytest.raises(Cancelled):
        shell.sync(source, str(target), excludes=[], timeout=60.0, cancel=cancel)
    wait_until(lambda: not rsyncs(), timeout=60.0, what='rsync to end')
    assert shell.run(Command(('true',)), timeout=60.0).returncode == 0


def sized(folder: Path, size: int) -> Path:
    """Return a folder with one file of a size, made of nothing."""
    folder.mkdir()
    with open(folder / 'big', 'wb') as file:
        file.truncate(size)
    return folder
