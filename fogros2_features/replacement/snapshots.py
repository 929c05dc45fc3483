# SPDX-License-Identifier: Apache-2.0
"""
Copy a folder of nodes to snapshots on the robot, and from there to another machine.

A snapshot gets its final name, a number, when the copy is complete. A copy that was cut off, or
during which the folder changed, is never used. Unchanged files are hard links to the snapshot
before, so that only changes cross the network.
"""

from __future__ import annotations

from pathlib import Path
import re
import threading
from typing import Optional

from fogros2 import untrusted
from fogros2.errors import ConnectError, DeadlineExceeded, FogError, ShellError
from fogros2.model import Command
from fogros2.shell import retried, Shell
from fogros2.shell.command_line import remote_path
from fogros2.store import delete_folder

#: Largest folder in bytes.
LIMIT = 2 << 30
#: The form of a hash.
_HASH = re.compile('[0-9a-f]{64}')
#: Seconds in which a copy makes no progress.
TIMEOUT = 600.0
#: Attempts to copy a folder that changes meanwhile.
ATTEMPTS = 3

# Print the size of the folder $1 in bytes, and a hash of its files' names, sizes and times.
_LOOK = """\
[ -e {0} ] || {{ echo missing; exit 0; }}
cd -- {0} && bad=$(find . ! -readable -print -quit) || bad=.
[ -z "$bad" ] || {{ echo unreadable "$bad"; exit 0; }}
du -sb . | cut -f 1
find . -printf '%P %y %s %T@ %C@\\n' | LC_ALL=C sort | sha256sum
"""
# Keep a folder that was there before.
_ASIDE = 'if [ -e {0} ] && [ ! -e {1} ]; then mv -T -- {0} {1}; echo moved; fi'


class Checkpoint:
    """
    The snapshots of one folder; the caller makes one call at a time.

    :param folder: as ``check_folder`` returns it.
    :param store: the folder of the snapshots on the robot.
    :param cancel: when set, a copy raises Cancelled.
    """

    def __init__(
        self, folder: str, store: Path, cancel: Optional[threading.Event] = None,
    ) -> None:
        self.folder = folder
        self._store = store
        self._cancel = cancel
        self._last: tuple[int, str] = (0, '')
        #: Whether the nodes' folder lacks what the newest snapshot has.
        self._unrestored = False

    @property
    def newest(self) -> Optional[Path]:
        """The newest complete snapshot, None if there is none."""
        names = [path.name for path in self._store.glob('[0-9]*')]
        return self._store / max(names) if names else None

    def save(self, shell: Shell, *, still: bool) -> bool:
        """
        Copy the folder of a machine, or of the robot, to a new snapshot.

        :param still: whether its files are known to be consistent.
        :return: False if there is no folder, or nothing has changed.
        :raises FogError: the folder was not copied; the last snapshot stays.
        """
        if self._unrestored:
            raise ShellError('the last one was not restored, and stays for the next machine')
        for _ in range(ATTEMPTS):
            before = self._look(shell)
            if not before or (id(shell), before) == self._last:
                return False
            partial = self._store / 'partial'
            try:
                self._store.mkdir(0o700, parents=True, exist_ok=True)
                shell.fetch(self.folder, partial, known=self.newest, limit=LIMIT,
                            timeout=TIMEOUT, cancel=self._cancel)
            except (ConnectError, DeadlineExceeded):
                raise  # the next copy continues this one
            except (FogError, OSError) as error:
                delete_folder(partial)
                if isinstance(error, FogError):
                    raise
                raise ShellError(f'{self._store} can not be written: {error.strerror}') from error
            if still or self._look(shell) == before:
                self._commit(partial)
                self._last = (id(shell), before)
                return True
        raise ShellError(f'{self.folder} changes faster than it can be copied',
                         'offer the service ~/checkpoint, or write there less often')

    def _look(self, shell: Shell) -> str:
        """Return what changes with the folder's files, '' if there is no folder."""
        words = shell.run(
            Command.script(_LOOK.format(remote_path(self.folder)), what=f'read {self.folder}'),
            timeout=60.0, cancel=self._cancel).stdout.split()
        if words[:1] == ['unreadable']:
            raise ShellError(f'{" ".join(words[1:])} in {self.folder} can not be read',
                             'give the login user the right to read it')
        if words[:1] == ['missing']:
            return ''
        try:
            size, digest = untrusted.number(words[0]), untrusted.matched(_HASH, words[1])
        except (untrusted.InvalidMessage, IndexError) as error:
            raise ShellError(f'the size of {self.folder} is not known: {error}',
                             'the machine may be hijacked: delete it') from error
        if size > LIMIT:
            raise ShellError(
                f'{self.folder} has {size / 1e9:.1f} GB, and a checkpoint at most '
                f'{LIMIT / 1e9:.1f} GB', 'write what a restart needs to a folder of its own')
        return digest

    def _commit(self, partial: Path) -> None:
        before = self.newest
        partial.rename(self._store / f'{int(before.name) + 1 if before else 1:08d}')
        if before is not None:
            delete_folder(before)

    def restore(self, shell: Shell, aside: str = '') -> bool:
        """
        Make the folder equal to the newest snapshot; return False if there is none.

        :param aside: suffix that a folder gets that was there before; '' to replace it.
        :raises FogError: it cannot be written.
        """
        newest = self.newest
        if newest is None:
            return False
        self._unrestored = True
        if aside:
            shell.run(Command.script(_ASIDE.format(
                remote_path(self.folder), remote_path(self.folder + aside)),
                what=f'keep {self.folder}'), timeout=60.0)
        retried(lambda: shell.sync(
            newest, self.folder, excludes=(), timeout=TIMEOUT, cancel=self._cancel))
        self._unrestored = False
        return True
