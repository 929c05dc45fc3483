# SPDX-License-Identifier: Apache-2.0
"""Note on a VPN interface whose launch it is, so that gc can delete it without a state folder."""

from __future__ import annotations

import os
from pathlib import Path
import re
from typing import Optional

from fogros2.model import Command, VpnInterface
from fogros2.store import process_alive, process_start

_MARK = 'fogros2'
INTERFACES = Path('/sys/class/net')
#: Name of a launch's interface on the robot: ``fog`` and the launch's id.
_NAME = re.compile('fog([0-9a-f]{6})')


def note(interface: VpnInterface) -> Command:
    """Return the command that names this process as the owner of an interface."""
    return Command(('ip', 'link', 'set', 'dev', interface.name, 'alias', ' '.join([
        *_marks(), str(os.getpid()), str(process_start(os.getpid()))])), sudo=True,
        what='note whose interface it is')


def _marks() -> list[str]:
    # another container may share the network, but not the process ids
    return [_MARK, os.readlink('/proc/self/ns/pid')]


def alive(name: str) -> Optional[bool]:
    """Return whether the owner of an interface runs, None if that is not known here."""
    try:
        *marks, pid, start = (INTERFACES / name / 'ifalias').read_text().split()
        if marks != _marks():
            return None
        if process_start(int(pid)) is None:
            os.kill(int(pid), 0)  # PermissionError: another account's, which hidepid hides
        return process_alive(int(pid), int(start))
    except ProcessLookupError:
        return False
    except (OSError, ValueError):
        return None


def abandoned() -> list[str]:
    """Return the ids of dead launches, of any state folder, whose interfaces still exist."""
    launches = [match[1] for path in sorted(INTERFACES.glob('fog*'))
                if (match := _NAME.fullmatch(path.name))]
    return [launch for launch in launches if alive(f'fog{launch}') is False]
