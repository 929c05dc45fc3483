# SPDX-License-Identifier: Apache-2.0
"""
The certificate and the token by which others than the robot come in, made on the machine.

Neither key nor certificate nor token is ever sent there. The robot reads the token and the
certificate over its Shell when somebody asks for them (``ros2 fog monitor --share``).
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
import secrets
import shutil
import ssl

from fogros2 import process
from fogros2.model import Command

#: Days for which a certificate is valid; longer than machines live.
DAYS = 365
_SECONDS = 60.0


@dataclasses.dataclass(frozen=True)
class Credentials:
    """Paths of PEM files, and of one that holds the token."""

    folder: Path

    @property
    def certificate(self) -> Path:
        """The certificate's path."""
        return self.folder / 'certificate.pem'

    @property
    def key(self) -> Path:
        """The private key's path."""
        return self.folder / 'key.pem'

    @property
    def token(self) -> Path:
        """The token's path."""
        return self.folder / 'token'


def folder_of(agent: str, port: int, launch: str) -> str:
    """
    Return where they are on a machine.

    :param agent: the agent's folder there.
    :param port: the bridge's.
    """
    return f'{agent}/monitor-{port}/{launch}'


def make(folder: Path, name: str) -> Credentials:
    """
    Make what isn't there yet, and remove what earlier launches had beside it.

    :param folder: 0700 with what is above it; the launch's own.
    :param name: the machine's.
    :raises FogError: there is no ``openssl``, or it fails.
    """
    found = Credentials(folder)
    if found.token.exists():
        return found
    shutil.rmtree(folder.parent, ignore_errors=True)
    for each in (folder.parent, folder):
        each.mkdir(mode=0o700)
    process.run(Command((
        'openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1',
        '-nodes', '-sha256', '-days', str(DAYS), '-keyout', str(found.key),
        '-out', str(found.certificate), '-subj', f'/CN={name}',
        '-addext', f'subjectAltName=DNS:{name}'), what='make a certificate'), timeout=_SECONDS)
    found.key.chmod(0o600)
    # last: where it is, all is
    found.token.write_text(secrets.token_urlsafe(24) + '\n')
    return found


def fingerprint(certificate: str) -> str:
    """
    Return a certificate's SHA-256, as browsers show it.

    :param certificate: PEM.
    """
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate)).hexdigest().upper()
    return ':'.join(digest[at:at + 2] for at in range(0, len(digest), 2))
