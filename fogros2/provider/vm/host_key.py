# SPDX-License-Identifier: Apache-2.0
"""The one-time SSH host key of a machine: known before the machine exists, replaced at once."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import struct


@dataclasses.dataclass(frozen=True)
class HostKey:
    """
    A key pair in OpenSSH's formats.

    :param private: the content of a key file.
    :param public: ``ssh-ed25519 AAAA...``.
    """

    private: str = dataclasses.field(repr=False)
    public: str


def one_time(token: str) -> HostKey:
    """
    Derive an Ed25519 host key from the token of a request.

    A repeated request with the same token is then the same request, byte by byte. The token is a
    random secret in the launch's store. Source of the file format: OpenSSH's PROTOCOL.key.
    """
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

    seed = hashlib.sha256(b'fogros2 one-time host key\0' + token.encode()).digest()
    public = Ed25519PrivateKey.from_private_bytes(seed).public_key().public_bytes(
        Encoding.Raw, PublicFormat.Raw)
    blob = _text(b'ssh-ed25519') + _text(public)
    check = hashlib.sha256(b'check\0' + seed).digest()[:4]
    secret = check + check + blob + _text(seed + public) + _text(b'fogros2')
    secret += bytes(range(1, 1 + -len(secret) % 8))
    whole = (b'openssh-key-v1\0' + _text(b'none') + _text(b'none') + _text(b'')
             + struct.pack('>I', 1) + _text(blob) + _text(secret))
    text = base64.b64encode(whole).decode()
    lines = [text[start:start + 70] for start in range(0, len(text), 70)]
    return HostKey(
        '\n'.join(['-----BEGIN OPENSSH PRIVATE KEY-----', *lines,
                   '-----END OPENSSH PRIVATE KEY-----', '']),
        f'ssh-ed25519 {base64.b64encode(blob).decode()}')


def _text(data: bytes) -> bytes:
    return struct.pack('>I', len(data)) + data
