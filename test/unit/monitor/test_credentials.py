# SPDX-License-Identifier: Apache-2.0
"""The certificate and the token, as they are made on a machine."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import socket
import ssl
import stat

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.store import Store
from fogros2_monitor import access, action, addresses, credentials

with_openssl = pytest.mark.skipif(shutil.which('openssl') is None, reason='needs openssl')


@with_openssl
def test_credentials_are_private_and_kept_for_a_launch(tmp_path):
    folder = Path(addresses.folder_of(str(tmp_path), 8765, 'a1b2c3'))
    made = credentials.make(folder, 'planner')
    token = made.token.read_text()
    assert len(token.strip()) == 32
    for path in (folder, folder.parent, made.key, made.token):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(made.certificate, made.key)
    # a bridge that ended is started again, and who was let in stays in
    assert credentials.make(folder, 'planner').token.read_text() == token

    another = credentials.make(folder.parent / 'd4e5f6', 'planner')
    assert another.token.read_text() != token
    assert not folder.exists()


def test_launches_with_one_name_on_the_robot_keep_their_tokens():
    top = addresses.on_robot(Store(), 'mapper')
    with socket.create_server(('127.0.0.1', 0)) as gate, \
            socket.create_server(('127.0.0.1', 0)) as further:
        port, another = gate.getsockname()[1], further.getsockname()[1]
        first, dead, second, beside = (
            Path(addresses.folder_of(str(top), at, addresses.of_process(pid)))
            for at, pid in ((port, os.getpid()), (port, 2 ** 22), (port, 1), (another, 1)))
        token = credentials.make_token(first).token.read_text().strip()
        os.utime(credentials.Credentials(first).token, (1.0, 1.0))
        for folder in (dead, second):
            credentials.make_token(folder)
        assert access.on_robot('mapper') == (port, token) and not dead.exists()
        theirs = credentials.make_token(beside).token.read_text().strip()
        action._remove(first)
        action._remove(second)
        assert access.on_robot('mapper') == (another, theirs)
    action._remove(beside)
    assert not top.exists()


@with_openssl
def test_fingerprint_is_that_of_openssl(tmp_path):
    made = credentials.make(Path(addresses.folder_of(str(tmp_path), 1, 'x')), 'planner')
    said = process.run(Command(('openssl', 'x509', '-in', str(made.certificate), '-noout',
                        '-fingerprint', '-sha256')), timeout=20).stdout
    assert said.strip().partition('=')[2] == credentials.fingerprint(
        made.certificate.read_text())


def test_foreign_folder_is_not_emptied(tmp_path):
    (tmp_path / 'mine').touch()
    assert credentials.make_token(tmp_path / 'secrets').token.exists()
    assert (tmp_path / 'mine').exists()


def test_machine_without_openssl_admits_nobody_else(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(process, 'argv', lambda command: ['/no/such/openssl'])
    serve = pytest.importorskip(
        'fogros2_monitor.serve', reason='rclpy is not installed')
    folder = addresses.folder_of(str(tmp_path), 8765, 'a1b2c3')
    assert serve.public_port(8766, folder, 'planner') == []
    assert 'nobody but the robot is let in: ' in capsys.readouterr().err
