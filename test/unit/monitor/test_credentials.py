# SPDX-License-Identifier: Apache-2.0
"""The certificate and the token, as they are made on a machine."""

from __future__ import annotations

from pathlib import Path
import shutil
import ssl
import stat

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2_monitor import addresses, credentials

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
