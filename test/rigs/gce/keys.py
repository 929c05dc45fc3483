# SPDX-License-Identifier: Apache-2.0
"""The credentials of a box: a service account's key file, as Google hands it out."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa


@functools.cache
def pair() -> tuple[str, Any]:
    """Return a private key (PEM) and its public key, the same for all boxes of a process."""
    key = rsa.generate_private_key(65537, 2048)
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption()).decode(), key.public_key()


def public(private: str) -> Any:
    """Return the public key of a private key (PEM)."""
    key: Any = serialization.load_pem_private_key(private.encode(), None)
    return key.public_key()


def write(path: Path, private: str, url: str, project: str = 'robots') -> Path:
    """Write the key file of an account whose tokens come from a box at ``url``."""
    path.write_text(json.dumps({
        'type': 'service_account', 'project_id': project, 'private_key_id': '1',
        'private_key': private, 'client_email': f'tests@{project}.iam.gserviceaccount.com',
        'client_id': '1', 'token_uri': f'{url}/token'}))
    path.chmod(0o600)
    return path
