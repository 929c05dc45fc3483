# SPDX-License-Identifier: Apache-2.0
"""An SSH server of a test's own, on loopback, with keys of its own."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
import getpass
import os
from pathlib import Path
import signal
import socket
import subprocess
from typing import Optional

from fogros2 import process
from fogros2.model import Command, Endpoint
from fogros2.waiting import wait_until

# a login shell that is bash reads the user's ~/.bashrc for sshd at the first shell level alone:
# what stands there, and what a cut connection leaves of it, is none of a test's business
_CONFIG = """\
ListenAddress 127.0.0.1
Port {port}
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/authorized_keys
PidFile none
StrictModes no
UsePAM no
UseDNS no
PasswordAuthentication no
KbdInteractiveAuthentication no
PermitRootLogin prohibit-password
PrintMotd no
LogLevel ERROR
SetEnv SHLVL=2
"""


@dataclasses.dataclass
class PrivateSshd:
    """
    A running SSH server; logs in as the user of this process.

    :param folder: holds the configuration, ``host_key``, the login key ``id`` and the log.
    """

    folder: Path
    port: int
    extra: str = ''
    child: Optional[subprocess.Popen[bytes]] = None

    @property
    def host_key(self) -> str:
        """Return the public host key, ``ssh-ed25519 AAAA...``."""
        return ' '.join((self.folder / 'host_key.pub').read_text().split()[:2])

    @property
    def endpoint(self) -> Endpoint:
        """Return how a Shell reaches it, the host key pinned."""
        return Endpoint('ssh', '127.0.0.1', self.port, getpass.getuser(), self.host_key,
                        str(self.folder / 'id'))

    def start(self) -> None:
        """Start it and wait until it listens."""
        config = self.folder / 'sshd_config'
        # of two lines with one keyword sshd takes the first
        config.write_text(
            self.extra + _CONFIG.format(port=self.port, folder=self.folder))
        sshd = process.which('sshd')
        assert sshd is not None
        # its children belong to its session: one signal ends them all
        self.child = subprocess.Popen(
            [sshd, '-D', '-f', str(config), '-E', str(self.folder / 'log')],
            start_new_session=True, stdin=subprocess.DEVNULL)
        wait_until(self._listens, timeout=60.0, what='sshd to listen',
                   hint=str(self.folder / 'log'))

    def _listens(self) -> bool:
        assert self.child is not None
        assert self.child.poll() is None, (self.folder / 'log').read_text()
        with socket.socket() as probe:
            return probe.connect_ex(('127.0.0.1', self.port)) == 0

    def sessions(self) -> list[int]:
        """Return the processes that serve connections."""
        assert self.child is not None
        found, look = [], [self.child.pid]
        while look:
            parent = look.pop()
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                for task in Path(f'/proc/{parent}/task').iterdir():
                    look += [int(word) for word in (task / 'children').read_text().split()]
            found.append(parent)
        return found[1:]

    def cut(self) -> None:
        """End every connection at once, with what runs in it."""
        for pid in self.sessions():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def stop(self) -> None:
        """End it and every connection."""
        if self.child is not None:
            self.cut()
            self.child.terminate()
            self.child.wait(60.0)
            self.child = None


def free_port() -> int:
    """Return a TCP port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def private_sshd(folder: Path, extra: str = '') -> Iterator[PrivateSshd]:
    """
    Run an SSH server for the time of the block.

    :param folder: an empty folder for its files.
    :param extra: more lines for its configuration, which win over its own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in ('host_key', 'id'):
        process.run(Command(('ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', 'test',
                             '-f', str(folder / name))), timeout=30.0)
    (folder / 'authorized_keys').write_text((folder / 'id.pub').read_text())
    server = PrivateSshd(folder, free_port(), extra)
    with contextlib.ExitStack() as undo:
        if os.geteuid() == 0:
            # as root it insists on this folder of its service, which stays: another test's server
            # would refuse connections without it
            os.makedirs('/run/sshd', 0o755, exist_ok=True)
        undo.callback(server.stop)
        server.start()
        yield server
