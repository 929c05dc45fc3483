# SPDX-License-Identifier: Apache-2.0
"""The host keys that known_hosts accepts and refuses, as OpenSSH reads it."""

from __future__ import annotations

import base64
import dataclasses
import fnmatch
from pathlib import Path
import time

from fogros2 import process
from fogros2.errors import HostKeyError
from fogros2.model import Command
from fogros2.shell.ssh_config import Settings

#: What the names of types have at their end if the key is a certificate.
CERTIFICATE = '-cert-v01@openssh.com'
_OF_A_HOST = 2


@dataclasses.dataclass(frozen=True)
class Known:
    """
    Host keys, each as ``type base64``.

    :param authorities: keys that sign the certificates of hosts.
    """

    keys: tuple[str, ...] = ()
    authorities: tuple[str, ...] = ()
    revoked: tuple[str, ...] = ()


def label_of(settings: Settings) -> str:
    """Return the host's name in known_hosts."""
    if settings.label or settings.port == 22:
        return settings.label or settings.host
    return f'[{settings.host}]:{settings.port}'


def look_up(settings: Settings) -> Known:
    """
    Return what the files of known_hosts say of a host.

    :raises HostKeyError: no key is known, and a file cannot be read.
    :raises PrerequisiteError: OpenSSH's ssh-keygen is missing.
    """
    files, error = list[Path](), None
    for file in (Path(name).expanduser() for name in settings.known_hosts):
        try:
            with file.open('rb'):
                files.append(file)
        except FileNotFoundError:
            continue
        except OSError as failed:
            error = failed
    known = _look_up(files, label_of(settings))
    if not known.keys and settings.port != 22 and not settings.label:
        # a key of the same host is accepted at its other ports
        plain = _look_up(files, settings.host)
        known = dataclasses.replace(
            known, keys=plain.keys, revoked=(*known.revoked, *plain.revoked))
    if error is not None and not known.keys and not known.authorities:
        raise HostKeyError(f'{error.filename} can not be read: {error.strerror}') from error
    return known


def _look_up(files: list[Path], label: str) -> Known:
    keys: dict[str, list[str]] = {'': [], '@cert-authority': [], '@revoked': []}
    for file in files:
        process.require(['ssh-keygen'], package_of={'ssh-keygen': 'openssh-client'})
        # it knows patterns and hashed names, and skips damaged lines
        for line in process.run(Command(('ssh-keygen', '-F', label.lower(), '-f', str(file))),
                                timeout=10.0, check=False).stdout.splitlines():
            words = line.split()
            marker = words.pop(0) if words and words[0].startswith('@') else ''
            if len(words) > 2 and words[0] != '#' and _is_key(*words[1:3]):
                keys[marker].append(' '.join(words[1:3]))
    return Known(*map(tuple, keys.values()))


def _is_key(kind: str, text: str) -> bool:
    """Return whether a key is undamaged, as far as its type."""
    try:
        blob = base64.b64decode(text, validate=True)
    except ValueError:
        return False
    return blob[:4 + len(kind)] == len(kind).to_bytes(4, 'big') + kind.encode()


def fault_of(certificate: bytes, host: str, known: Known) -> str | None:
    """
    Return why a host's certificate is not valid, '' if it is; None for one of another authority.

    :param host: the name that the certificate has to be for.
    """
    try:
        return _fault_of(certificate, host, known)
    except ValueError:  # of bytes that are no UTF-8, or no key
        return 'is damaged'


def _fault_of(certificate: bytes, host: str, known: Known) -> str | None:
    import paramiko
    message = paramiko.Message(certificate)
    kind = message.get_text()
    for _ in range(2 if kind.startswith('ssh-ed25519') else 3):
        message.get_binary()  # a random value, and the parts of the key
    message.get_int64()
    role, _ = message.get_int(), message.get_binary()
    names, principals = paramiko.Message(message.get_binary()), []
    while names.get_remainder():
        principals.append(names.get_text())
    begin, end = message.get_int64(), message.get_int64()
    critical, _, _ = message.get_binary(), message.get_binary(), message.get_binary()
    signer = message.get_binary()
    signed, signature = message.get_so_far(), message.get_binary()
    kind = paramiko.Message(signer).get_text()
    line = f'{kind} {base64.b64encode(signer).decode()}'
    if line in known.revoked:
        return 'is of a revoked authority'
    if line not in known.authorities:
        return None
    classes = {'ssh-ed25519': paramiko.Ed25519Key, 'ssh-rsa': paramiko.RSAKey}
    if paramiko.Message(signature).get_text() == 'ssh-rsa' or not classes.get(
            kind, paramiko.ECDSAKey)(data=signer).verify_ssh_sig(
                signed, paramiko.Message(signature)):
        return 'has a wrong signature'
    if role != _OF_A_HOST or critical:
        return 'is not for hosts'
    if not begin <= time.time() < end:
        return 'is not valid now'
    if principals and not any(
            fnmatch.fnmatchcase(host, name.replace('[', '[[]')) for name in principals):
        return f"is for {', '.join(principals)}"
    return ''
