# SPDX-License-Identifier: Apache-2.0
"""A host key that was handed over gives way to another, under connections that go on."""

from __future__ import annotations

import dataclasses
import os

import pytest

from fogros2 import process
from fogros2.errors import CommandError, ConnectError, HostKeyError
from fogros2.model import Command
from fogros2.shell import host_key
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import wait_until
from rigs.sshd import private_sshd


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


def test_a_server_gets_a_new_key_and_connections_go_on(root, tmp_path):
    if os.geteuid() != 0:
        pytest.skip("the server of this test is its user's, not root's")
    folder = tmp_path / 'sshd'
    process.run(Command(('ssh-keygen', '-q', '-t', 'ecdsa', '-N', '', '-f',
                         str(tmp_path / 'other'))), timeout=30)
    with private_sshd(folder, f'HostKey {tmp_path / "other"}\n') as server:
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


def test_server_without_the_key_type_is_reported(root, tmp_path, monkeypatch):
    if os.geteuid() != 0:
        pytest.skip("the server of this test is its user's, not root's")
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
