# SPDX-License-Identifier: Apache-2.0
"""Run commands on a machine by SSH."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from typing import Optional, TYPE_CHECKING

from fogros2.errors import ConnectError, DeadlineExceeded, FogError, ShellError
from fogros2.model import Command
from fogros2.shell import command_line, flow, ssh_connection
from fogros2.shell.lines import Channel, close, Output, take_errors
from fogros2.shell.remote import RemoteShell
from fogros2.untrusted import clean
from fogros2.waiting import wait_until

if TYPE_CHECKING:
    import paramiko

#: Time-out of one attempt to connect or to open a session, in seconds.
_ATTEMPT = 10.0
#: Seconds that an abandoned command has to announce its process.
_ANNOUNCE = 1.0


class SSHShell(RemoteShell['paramiko.Transport']):
    """
    A Shell for endpoints of kind 'ssh'.

    :param name: the machine's name, for messages.
    :param timeout: seconds for which to try to connect.
    """

    # paramiko may send the end of an input behind the close of its channel, if the command has
    # ended meanwhile; OpenSSH then closes the whole connection.
    ends_empty_input = False

    #: Start to import paramiko; see :func:`fogros2.shell.warm`.
    warm = staticmethod(ssh_connection.warm)

    def _connect(
        self, timeout: float, cancel: Optional[threading.Event],
    ) -> paramiko.Transport:
        return ssh_connection.connect(
            self.endpoint, name=self.name, timeout=min(timeout, _ATTEMPT))

    def _session(
        self, transport: paramiko.Transport, timeout: float,
        cancel: Optional[threading.Event] = None,
    ) -> paramiko.Channel:
        """
        Open a channel; wait while the server allows no more sessions.

        :raises ConnectError: the machine no longer answers; the connection is closed.
        :raises DeadlineExceeded: the server refused further sessions until the time-out.
        """
        import paramiko

        def attempt() -> Optional[paramiko.Channel]:
            begin = time.monotonic()
            limit = min(timeout, _ATTEMPT)
            try:
                return ssh_connection.limited(
                    transport.open_session(window_size=flow.LEAST, timeout=limit))
            except (paramiko.SSHException, EOFError, OSError) as error:
                # Either the connection was lost before. Or the server allows no more sessions,
                # and one of ours will end. Neither the exception (paramiko keeps one for all
                # threads) nor is_active() tells which.
                if time.monotonic() - begin >= limit or not transport.is_alive():
                    self._drop(transport)
                    raise ConnectError(f"'{self.name}' has not answered for {limit:g} s",
                                       "check the robot's network") from error
                return None

        return wait_until(
            attempt, timeout=timeout, longest=0.1, cancel=cancel,
            what=f"a session on '{self.name}'", hint='raise MaxSessions of its SSH server')

    def _start(
        self, connection: paramiko.Transport, command: Command | str | None, timeout: float,
        cancel: Optional[threading.Event] = None, size: Optional[tuple[int, int, str]] = None,
    ) -> Channel:
        import paramiko

        try:
            channel = self._session(connection, timeout, cancel)
            vars(channel)['_wait_for_event'] = functools.partial(self._answered, channel, timeout)
            if size is not None:
                rows, columns, kind = size
                channel.get_pty(kind, columns, rows)
            if command is None:
                channel.invoke_shell()
                return channel
            line = command if isinstance(command, str) else \
                command_line.remote_line(command, user=self.user)
            if size is None:
                line = command_line.marked_line(line)
                vars(channel)['recv'] = functools.partial(self._first, channel, bytearray())
            channel.exec_command(line)
            return channel
        except (paramiko.SSHException, EOFError, OSError) as error:
            # If another thread closed the connection, is_alive() may still return True.
            if isinstance(error, (EOFError, OSError)) or not connection.is_alive():
                self._drop(connection)
            raise ConnectError(f"'{self.name}' can not start a command: {error}") from error

    def _answered(self, channel: paramiko.Channel, timeout: float) -> None:
        """
        Wait until the server has answered a request; paramiko would wait for good.

        :raises DeadlineExceeded: it has not answered.
        """
        if not channel.event.wait(timeout):
            close(channel)
            raise DeadlineExceeded(f"'{self.name}' has not begun a command within {timeout:g} s")
        type(channel)._wait_for_event(channel)  # type: ignore[attr-defined]

    def _first(self, channel: paramiko.Channel, before: bytearray, size: int) -> bytes:
        """
        Receive without what the login shell printed before the command, such as in ~/.bashrc.

        :raises ShellError: it ended, and ran no command.
        """
        begin = time.monotonic()
        while True:
            data = type(channel).recv(channel, size)
            before += data
            _, mark, rest = bytes(before).partition(command_line.MARK)
            if mark:
                del vars(channel)['recv']
                return rest or channel.recv(size)
            limit = channel.gettimeout()
            if not data and channel.status_event.wait(limit):
                if channel.recv_exit_status() == -1:
                    return b''  # the connection is lost
                before += take_errors(channel)
                line = clean(before.decode(errors='replace')).strip().split('\n')[-1]
                raise ShellError(f"the login shell of '{self.name}' runs no command"
                                 + (f', it prints: {line}' if line else ''),
                                 'see its ~/.bashrc, and authorized_keys')
            del before[:-len(command_line.MARK) - 1000]
            if limit is not None and time.monotonic() - begin >= limit:
                raise TimeoutError

    def _announced(self, command: Command) -> str:
        line = command_line.announced_line(command, user=self.user)
        return line if command.input else f'{line} </dev/null'

    def _abandon(self, command: Command, channel: Channel, output: Output) -> None:
        """Kill the processes of an abandoned command; closing its streams does not end them."""
        until = time.monotonic() + _ANNOUNCE
        # the machine itself may not answer
        with contextlib.suppress(FogError, ConnectionError):
            while not output.pid and time.monotonic() < until:
                channel.settimeout(0.05)
                with contextlib.suppress(TimeoutError):
                    if not (data := channel.recv(1 << 16)):
                        break
                    output.add(data)
            if output.pid:
                self.run(
                    Command(('sh', '-c', command_line.end_script(output.pid)), sudo=command.sudo),
                    timeout=3.0, check=False)
