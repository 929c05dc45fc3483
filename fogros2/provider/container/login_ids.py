# SPDX-License-Identifier: Apache-2.0
"""
Choose the user id of a machine's login user.

A container has this computer's user ids. An account with the id of a process in the container
could look into its root through /proc, and write there.
"""

from __future__ import annotations

from collections.abc import Sequence
import grp
import hashlib
from pathlib import Path
import pwd

from fogros2.errors import PrerequisiteError

#: Ids that systemd's list of ranges (UIDS-GIDS) leaves free, without those of sssd's id mapping,
#: and of accounts of features; and ids for a computer in a namespace of users that lacks them.
IDS, FEW_IDS = range(0x78000000, 0x7c000000), range(20000, 60000)
#: Ranges of ids that accounts may use in containers of their own.
SUBORDINATE = (Path('/etc/subuid'), Path('/etc/subgid'))


def login_id(token: str, subordinate: Sequence[Path] = SUBORDINATE) -> int:
    """
    Return an id that no account, group or subordinate range of this computer has.

    :param token: of the machine; another machine has another token, and so another id.
    :raises PrerequisiteError: subordinate ranges or accounts have all ids.
    """
    lines = [line for path in subordinate if path.exists()
             for line in path.read_text(errors='replace').splitlines()]
    ranges = [(int(words[1]), int(words[1]) + int(words[2])) for line in lines
              if len(words := line.split(':')) == 3 and words[1].isdigit() and words[2].isdigit()]
    mapped = [[int(word) for word in line.split()]
              for line in Path('/proc/self/uid_map').read_text().splitlines()]
    some = IDS if any(first + count > IDS[-1] for first, _, count in mapped) else FEW_IDS
    for attempt in range(100):
        digest = hashlib.sha256(f'{token} {attempt}'.encode()).digest()
        number = some[int.from_bytes(digest[:8], 'big') % len(some)]
        if not _known(number) and not any(first <= number < end for first, end in ranges):
            return number
    raise PrerequisiteError(
        f'no user id from {some[0]} to {some[-1]} is free for a container machine',
        f"leave some out of {' and '.join(map(str, subordinate))}")


def _known(number: int) -> bool:
    for look in (pwd.getpwuid, grp.getgrgid):
        try:
            look(number)
            return True
        except KeyError:
            continue
    return False
