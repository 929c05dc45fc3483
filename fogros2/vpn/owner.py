# SPDX-License-Identifier: Apache-2.0
"""Note on a VPN interface whose launch it is, so that gc can delete it without a state folder."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
import re
from typing import Optional

from fogros2.model import Command, VpnInterface
from fogros2.store import process_alive, process_start

_MARK = 'fogros2'
#: Name of a launch's interface on the robot: ``fog`` and the launch's id.
_NAME = re.compile('fog([0-9a-f]{6})')


def note(interface: VpnInterface) -> Command:
    """Return the command that names this process as the owner of an interface."""
    root = Path(interface.key_file).parent.parent.parent  # root/launches/ID/vpn.key
    return Command(('ip', 'link', 'set', 'dev', interface.name, 'alias', ' '.join([
        *_marks(root), str(os.getpid()), str(process_start(os.getpid()))])), sudo=True,
        what='note whose interface it is')


def _marks(root: Path) -> list[str]:
    # another container may share the network, but not the process ids
    return [_MARK, hashlib.sha256(str(root).encode()).hexdigest()[:16],
            os.readlink('/proc/self/ns/pid')]


def alive(name: str, root: Path) -> Optional[bool]:
    """
    Return whether the owner of an interface runs, None if that is not known here.

    :param root: the state folder of the launch.
    """
    try:
        *marks, pid, start = Path('/sys/class/net', name, 'ifalias').read_text().split()
        return process_alive(int(pid), int(start)) if marks == _marks(root) else None
    except (OSError, ValueError):
        return None


def abandoned(root: Path) -> list[str]:
    """Return the ids of a state folder's dead launches whose interfaces still exist."""
    found = [match[1] for name in sorted(os.listdir('/sys/class/net'))
             if (match := _NAME.fullmatch(name))]
    return [launch for launch in found if alive(f'fog{launch}', root) is False]
