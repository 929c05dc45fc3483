# SPDX-License-Identifier: Apache-2.0
"""
Create the token that admits viewers, and the TLS certificate for viewers other than the robot.

The machine creates the token, the key and the certificate, so nobody sends them to the machine.
``ros2 fog monitor`` reads the token and the certificate over the machine's Shell.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
import secrets
import shutil
import ssl

from fogros2 import process
from fogros2.model import Command
from fogros2_monitor import addresses

#: Validity of a certificate in days; longer than the lifetime of any machine.
DAYS = 365
_SECONDS = 60.0


class Credentials:
    """Paths of the token, and of the certificate and its private key (PEM)."""

    def __init__(self, folder: Path) -> None:
        self.token = folder / 'token'
        self.certificate, self.key = folder / 'certificate.pem', folder / 'key.pem'


def make_token(folder: Path) -> Credentials:
    """
    Create the token unless it exists; delete the credentials of launches that have ended.

    :param folder: folder of this launch, see ``addresses.folder_of``. The function creates
        the folder and its parents with mode 0700.
    :raises OSError: the folder is not writable.
    """
    credentials = Credentials(folder)
    if not credentials.token.exists():
        if folder.parent.name.startswith(addresses.CREDENTIALS):
            for other in folder.parent.glob('*'):
                if not addresses.is_used(other):
                    shutil.rmtree(other, ignore_errors=True)
        for each in (*reversed(folder.parents), folder):
            each.mkdir(mode=0o700, exist_ok=True)
        unfinished = folder / 'token.new'
        unfinished.touch(mode=0o600)
        unfinished.write_text(secrets.token_urlsafe(24) + '\n')
        unfinished.rename(credentials.token)
    return credentials


def make(folder: Path, name: str) -> Credentials:
    """
    Create the token, the key and the certificate, unless they exist.

    :param folder: see :func:`make_token`.
    :param name: name of the machine.
    :raises FogError: ``openssl`` is not installed, or it fails.
    """
    credentials = make_token(folder)
    if credentials.certificate.exists():
        return credentials
    unfinished = folder / 'certificate.new'
    process.run(Command((
        'openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1',
        '-nodes', '-sha256', '-days', str(DAYS), '-keyout', str(credentials.key),
        '-out', str(unfinished), '-subj', f'/CN={name}',
        '-addext', f'subjectAltName=DNS:{name}'), what='make a certificate'), timeout=_SECONDS)
    credentials.key.chmod(0o600)
    # The rename is the last step: if the certificate exists, so does the key.
    unfinished.rename(credentials.certificate)
    return credentials


def fingerprint(certificate: str) -> str:
    """
    Return a certificate's SHA-256 fingerprint in the form that browsers show.

    :param certificate: the certificate as PEM text.
    """
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate)).hexdigest().upper()
    return ':'.join(digest[at:at + 2] for at in range(0, len(digest), 2))
