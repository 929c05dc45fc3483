# SPDX-License-Identifier: Apache-2.0
"""Tests of sync over a real SSH server: both transports, and what can go wrong."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import shutil
import threading

import pytest

from fogros2 import process
from fogros2.errors import (
    Cancelled,
    CommandError,
    ConnectError,
    PrerequisiteError,
    ShellError,
)
from fogros2.model import Command
from fogros2.shell import relay, sync
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import wait_until
from rigs.sshd import private_sshd, PrivateSshd

pytestmark = [
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
    pytest.mark.skipif(process.which('rsync') is None, reason='needs rsync'),
]


@pytest.fixture(scope='module')
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrivateSshd]:
    with private_sshd(tmp_path_factory.mktemp('server') / 'sshd') as running:
        yield running


@pytest.fixture(scope='module')
def shell(server: PrivateSshd) -> Iterator[SSHShell]:
    with contextlib.closing(SSHShell(server.endpoint, name='planner', timeout=60.0)) as opened:
        yield opened


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


def test_a_target_in_the_home_is_found(server, source, tmp_path):
    name = f'.sync-target-{os.getpid()}'
    with contextlib.closing(SSHShell(server.endpoint, name='planner')) as shell:
        shell.sync(source / '1', f'~/{name}/x', excludes=[], timeout=60.0)
        home = shell.run(Command(('printenv', 'HOME')), timeout=60.0).stdout.strip()
        try:
            assert not compare(source / '1', Path(home, name, 'x'))
        finally:
            shutil.rmtree(Path(home, name))


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
    # a second's work would be over before a busy computer looks at the event
    source = sized(tmp_path / 'source', 16 << 30)
    cancel = threading.Event()
    with pytest.raises(Cancelled):
        shell.sync(source, str(tmp_path / 'sync-target'), excludes=[], timeout=60.0,
                   cancel=cancel, on_progress=lambda done, total: cancel.set())
    wait_until(lambda: not rsyncs(), timeout=60.0, what='rsync to end')
    assert shell.run(Command(('true',)), timeout=60.0).returncode == 0


def sized(folder: Path, size: int) -> Path:
    """Return a folder with one file of a size, made of nothing."""
    folder.mkdir()
    with open(folder / 'big', 'wb') as file:
        file.truncate(size)
    return folder
