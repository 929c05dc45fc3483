# SPDX-License-Identifier: Apache-2.0
"""The one-time SSH host key of a machine: known before the machine exists, replaced at once."""

from __future__ import annotations

import dataclasses
import functools
import hashlib


@dataclasses.dataclass(frozen=True)
class HostKey:
    """
    A key pair in OpenSSH's formats.

    :param private: the content of a key file.
    :param public: ``ssh-ed25519 AAAA...``.
    """

    private: str = dataclasses.field(repr=False)
    public: str


@functools.lru_cache
def one_time(token: str) -> HostKey:
    """
    Derive an Ed25519 host key from the token of a request.

    A repeated request with the same token is then the same request, byte by byte, in this
    process: the file of a private key has random bytes. The token is a random secret in the
    launch's store.
    """
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
        PublicFormat,
    )

    key = Ed25519PrivateKey.from_private_bytes(
        hashlib.sha256(b'fogros2 one-time host key\0' + token.encode()).digest())
    return HostKey(
        key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption()).decode(),
        key.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH).decode())
