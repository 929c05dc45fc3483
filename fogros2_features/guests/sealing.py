# SPDX-License-Identifier: Apache-2.0
"""
Seal bytes to an X25519 key; loads ``cryptography``, which takes a command line 0.1 s.

A sealed text is an ephemeral public key and a ChaCha20-Poly1305 ciphertext. Its key is HKDF-SHA256
of the shared secret with the recipient's key, salted with both public keys (as RFC 9180 does).
Each text has an ephemeral key of its own, so the nonce is constant.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)

_NONCE = bytes(12)


class WrongKey(Exception):
    """The text is sealed to another key, or was changed."""


def private_key() -> bytes:
    """Return a new private key."""
    return X25519PrivateKey.generate().private_bytes(
        Encoding.Raw, PrivateFormat.Raw, NoEncryption())


def public_key(private: bytes) -> bytes:
    """Return the public key of a private one."""
    return X25519PrivateKey.from_private_bytes(private).public_key().public_bytes(
        Encoding.Raw, PublicFormat.Raw)


def seal(content: bytes, recipient: bytes, label: bytes) -> bytes:
    """Return a content that only the holder of a key can read; ``label`` is authenticated too."""
    once = private_key()
    own = public_key(once)
    return own + _cipher(once, recipient, own, recipient).encrypt(_NONCE, content, label)


def unseal(sealed: bytes, private: bytes, label: bytes) -> bytes:
    """
    Return the content of what :func:`seal` returned.

    :raises WrongKey: it is sealed to another key, or was changed.
    :raises ValueError: it is too short, or its key is no key.
    """
    sender = sealed[:32]
    try:
        return _cipher(private, sender, sender, public_key(private)).decrypt(
            _NONCE, sealed[32:], label)
    except InvalidTag:
        raise WrongKey from None


def _cipher(private: bytes, other: bytes, sender: bytes, recipient: bytes) -> ChaCha20Poly1305:
    shared = X25519PrivateKey.from_private_bytes(private).exchange(
        X25519PublicKey.from_public_bytes(other))
    return ChaCha20Poly1305(HKDF(
        SHA256(), 32, salt=sender + recipient, info=b'fogros2 invitation').derive(shared))
