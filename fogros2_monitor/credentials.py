# SPDX-License-Identifier: Apache-2.0
"""
What lets viewers in, made on the machine: the token, and for others than the robot a certificate.

Neither key nor certificate nor token is ever sent there. The robot reads the token and the
certificate over its Shell when somebody asks for them (``ros2 fog monitor``).
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
from fogros2.monitor_addresses import CREDENTIALS

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


def make_token(folder: Path) -> Credentials:
    """
    Make the token unless it is there; remove earlier launches' beside it.

    :param folder: the launch's own, see ``monitor_addresses.folder_of``; made with what is above,
        0700.
    :raises OSError: it can't be written.
    """
    found = Credentials(folder)
    if not found.token.exists():
        if folder.parent.name.startswith(CREDENTIALS):
            shutil.rmtree(folder.parent, ignore_errors=True)
        for each in (*reversed(folder.parents), folder):
            each.mkdir(mode=0o700, exist_ok=True)
        unfinished = folder / 'token.new'
        unfinished.touch(mode=0o600)
        unfinished.write_text(secrets.token_urlsafe(24) + '\n')
        unfinished.rename(found.token)
    return found


def make(folder: Path, name: str) -> Credentials:
    """
    Make the token, the key and the certificate, each unless it is there.

    :param folder: see :func:`make_token`.
    :param name: the machine's.
    :raises FogError: there is no ``openssl``, or it fails.
    """
    found = make_token(folder)
    if found.certificate.exists():
        return found
    unfinished = folder / 'certificate.new'
    process.run(Command((
        'openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1',
        '-nodes', '-sha256', '-days', str(DAYS), '-keyout', str(found.key),
        '-out', str(unfinished), '-subj', f'/CN={name}',
        '-addext', f'subjectAltName=DNS:{name}'), what='make a certificate'), timeout=_SECONDS)
    found.key.chmod(0o600)
    # last: where it is, all is
    unfinished.rename(found.certificate)
    return found


def fingerprint(certificate: str) -> str:
    """
    Return a certificate's SHA-256, as browsers show it.

    :param certificate: PEM.
    """
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate)).hexdigest().upper()
    return ':'.join(digest[at:at + 2] for at in range(0, len(digest), 2))
