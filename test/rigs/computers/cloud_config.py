# SPDX-License-Identifier: Apache-2.0
"""
FogROS2's user data, as cloud-init would read it: what a boot of an instance has to do; pure.

It knows the modules that are named in ``KNOWN`` and refuses the rest aloud, since cloud-init
would pass over a misspelled key with a warning that nobody sees.
"""

from __future__ import annotations

import gzip
import json
from typing import Any
import zlib

#: The smallest limit of the clouds, before base64.
LIMIT = 16384
#: What a cloud-config may have here, and its type; the last line's change nothing.
KNOWN: dict[str, type] = {
    'bootcmd': list, 'hostname': str, 'runcmd': list, 'ssh_authorized_keys': list,
    'ssh_keys': dict, 'ssh_deletekeys': bool,
    'manage_etc_hosts': str, 'package_update': bool, 'package_upgrade': bool, 'ssh_pwauth': bool}


class UserDataError(ValueError):
    """The user data can't be carried out here."""


def parse(data: bytes) -> dict[str, Any]:
    """
    Return what user data asks for, as ``guest`` takes it: a cloud-config in JSON, maybe gzipped.

    :raises UserDataError: it is too long, malformed, or asks for what isn't known here.
    """
    if len(data) > LIMIT:
        raise UserDataError(f'User data is limited to {LIMIT} bytes')
    try:
        text = (gzip.decompress(data) if data[:2] == b'\x1f\x8b' else data).decode()
        first, _, body = text.partition('\n')
        if text and first != '#cloud-config':
            raise UserDataError(f'user data begins with {first[:40]!r}: no cloud-config')
        config = json.loads(body) if text else {}
    except (OSError, EOFError, zlib.error, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UserDataError(f'user data is damaged: {error}') from error
    for name, value in config.items():
        if not isinstance(value, KNOWN.get(name, ())):
            raise UserDataError(f'a cloud in a box knows no {name}: {value!r} in user data')
    keys = config.get('ssh_keys', {})
    if keys and set(keys) != {'ed25519_private', 'ed25519_public'}:
        raise UserDataError(f'ssh_keys knows no {", ".join(keys)}')
    return {'bootcmd': [], 'runcmd': [], 'hostname': '', 'ssh_authorized_keys': [], **config,
            'ssh_keys': keys}
