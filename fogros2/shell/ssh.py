# SPDX-License-Identifier: Apache-2.0
"""Run commands on a machine by SSH: one connection, many channels, reopened after a loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import functools
from pathlib import Path
import threading
import time
from typing import Optional, TYPE_CHECKING

from fogros2.errors import (
    Cancelled,
    ConnectError,
    DeadlineExceeded,
    FogError,
)
from fogros2.model import Command, Endpoint, Result, SyncReport
from fogros2.shell import command_line, ssh_connection, Stream, sync, terminal
from fogros2.shell.lines import LineStream, Output
from fogros2.waiting import wait_until

if TYPE_CHECKING:
    import paramiko

#: Seconds to wait for further output after a command's end, as its children may still write.
_DRAIN = 2.0
#: Largest input in bytes that fits into a channel's window, and needs no thread.
_INLINE = 1 << 16
#: Time-out of one attempt to connect or to open a session, in seconds; a cancel waits for it.
_ATTEMPT = 10.0


class SSHShell:
    """
    A Shell for endpoints of kind 'ssh'.

    :param name: the machine's name, for messages.
    :param timeout: seconds for which to try to connect.
    """

    @staticmethod
    def warm() -> None:
        """Start to import paramiko; see :func:`fogros2.shell.warm`."""
        ssh_connection.warm()

    def __init__(self, endpoint: Endpoint, *, name: str, timeout: float = 30.0) -> None:
        self.endpoint = endpoint
        self.name = name
        self.user = ssh_connection.user_of(endpoint)
        self._timeout = timeout
        self._lock = threading.Lock()
        self._transport: Optional[paramiko.Transport] = None
        # Only one thread connects at a time; close() does not wait for this lock.
        self._connecting = threading.Lock()
        self._closings = 0

    # -- connection -----------------------------------------------------------------------------

    def channel(
        self, timeout: Optional[float] = None, cancel: Optional[threading.Event] = None,
    ) -> paramiko.Channel:
        """
        Open a channel; open the connection first if necessary.

        :param timeout: seconds, at most the constructor's time-out.
        :raises ConnectError: the machine cannot be reached, or no longer answers.
        :raises DeadlineExceeded: the server refused further sessions until the time-out.
        """
        patience = min(self._timeout, timeout or self._timeout)
        refused = False

        def attempt() -> Optional[paramiko.Channel]:
            nonlocal refused
            channel, refused = self._try_channel(min(patience, _ATTEMPT))
            return channel

        try:
            return wait_until(
                attempt, timeout=patience, longest=0.1, cancel=cancel,
                what=f"a session on '{self.name}'", hint='raise MaxSessions of its SSH server')
        except DeadlineExceeded as error:
            if refused:
                raise
            raise ConnectError(f"'{self.name}' has not answered for {patience:g} s",
                               "check the robot's network") from error

    def _try_channel(self, patience: float) -> tuple[Optional[paramiko.Channel], bool]:
        """Return a channel, or None and whether the server answered with a refusal."""
        transport = self._connected(patience)
        import paramiko
        begin = time.monotonic()
        try:
            return transport.open_session(window_size=1 << 22, timeout=patience), False
        except (paramiko.SSHException, EOFError, OSError):
            # Either the connection was lost before, and no command has started. Or the server
            # allows no more sessions, and one of ours will end. Neither the exception (paramiko
            # keeps one for all threads) nor is_active() tells which.
            silent = time.monotonic() - begin >= patience
            if silent or not transport.is_alive():
                self._drop(transport)
            return None, not silent

    def _connected(self, patience: float) -> paramiko.Transport:
        until = time.monotonic() + patience
        with self._lock:
            transport = self._transport
        if transport is not None and transport.is_alive():
            return transport
        if not self._connecting.acquire(timeout=patience):
            raise ConnectError(f"'{self.name}' can not be reached: nothing has answered for "
                               f'{patience:g} s', "check the robot's network")
        try:
            with self._lock:
                transport, closings = self._transport, self._closings
            if transport is not None and transport.is_alive():
                return transport
            transport = ssh_connection.connect(
                self.endpoint, name=self.name, timeout=max(0.5, until - time.monotonic()))
            with self._lock:
                if closings == self._closings:
                    self._transport = transport
                    return transport
            transport.close()
            raise ConnectError(f"the connection to '{self.name}' was closed while it came up")
        finally:
            self._connecting.release()

    def _drop(self, transport: paramiko.Transport) -> None:
        with self._lock:
            if self._transport is transport:
                self._transport = None
        transport.close()

    def close(self) -> None:
        """Close the connection; the next call opens a new one."""
        with self._lock:
            transport, self._transport = self._transport, None
            self._closings += 1
        if transport is not None:
            transport.close()

    # -- commands -------------------------------------------------------------------------------

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Run a command on the machine, and wait for its end; see the protocol."""
        line = command_line.announced_line(command, user=self.user)
        begin = time.monotonic()
        if cancel is not None and cancel.is_set():
            raise Cancelled(_what(command))
        channel = self.start(line, timeout, cancel)
        output = _Announced(on_output)
        try:
            feeder = _feed(channel, command.input)
            self._collect(channel, output, begin + timeout, cancel, command)
            returncode = self._status(channel, command)
            if feeder is not None:
                feeder.join(_DRAIN)
        except (Cancelled, DeadlineExceeded):
            self._end(output.pid, command.sudo)
            raise
        finally:
            channel.close()
        result = Result(returncode, *output.text(), time.monotonic() - begin)
        return command_line.checked(command, result, f"'{self.name}'") if check else result

    def start(
        self, line: str, timeout: Optional[float] = None,
        cancel: Optional[threading.Event] = None,
    ) -> paramiko.Channel:
        """
        Start a command line on the machine, and return its channel.

        :param timeout: seconds until it runs, at most the constructor's time-out.
        :raises ConnectError: the machine cannot be reached.
        """
        import paramiko

        for attempt in (1, 2):
            channel = self.channel(timeout, cancel)
            try:
                channel.exec_command(line)
                return channel
            except (paramiko.SSHException, EOFError, OSError) as error:
                transport = channel.get_transport()
                # If another thread closed the connection, is_alive() may still return True.
                lost = isinstance(error, (EOFError, OSError)) or not transport.is_alive()
                if attempt == 2 or not lost:
                    raise ConnectError(f"'{self.name}' can not start a command: {error}") \
                        from error
                self._drop(transport)
        raise AssertionError('the second attempt returns or raises')

    def _collect(
        self, channel: paramiko.Channel, output: Output, deadline: float,
        cancel: Optional[threading.Event], command: Command,
    ) -> None:
        """Read until both streams have ended, the time is up, or ``cancel`` is set."""
        quiet_since = 0.0
        while True:
            now = time.monotonic()
            if cancel is not None and cancel.is_set():
                raise Cancelled(_what(command))
            if now >= deadline:
                raise DeadlineExceeded(
                    f"{_what(command)} took too long on '{self.name}'")
            channel.settimeout(min(0.05, deadline - now))
            try:
                data = channel.recv(1 << 16)
            except TimeoutError:
                if errors := _take_errors(channel):
                    output.add(err=errors)
                    quiet_since = 0.0
                elif channel.exit_status_ready():
                    # The command has ended, but its background processes hold its output open.
                    quiet_since = quiet_since or now
                    if now - quiet_since >= _DRAIN:
                        return
                continue
            output.add(data, _take_errors(channel))
            quiet_since = 0.0
            if data:
                continue
            # Standard output has ended; standard error ends with the channel.
            channel.settimeout(max(0.05, min(_DRAIN, deadline - now)))
            try:
                while more := channel.recv_stderr(1 << 16):
                    output.add(err=more)
            except TimeoutError:
                pass
            lost = channel.closed or not channel.get_transport().is_alive()
            if lost or channel.exit_status_ready():
                return
            _pause(channel, min(deadline, now + 0.05))

    def _status(self, channel: paramiko.Channel, command: Command) -> int:
        if not channel.exit_status_ready():
            raise ConnectError(f"the connection to '{self.name}' was lost while "
                               f'{_what(command)} ran there', "check the robot's network")
        status = channel.recv_exit_status()
        if status == -1 and not channel.eof_received:  # with eof, a signal ended the command
            raise ConnectError(f"the connection to '{self.name}' was lost while "
                               f'{_what(command)} ran there', "check the robot's network")
        return int(status)

    def _end(self, pid: int, sudo: bool) -> None:
        """Kill the processes of an abandoned command; closing its streams does not end them."""
        if pid:
            with contextlib.suppress(FogError):  # the machine itself may not answer
                self.run(Command(('sh', '-c', command_line.end_script(pid)), sudo=sudo),
                         timeout=3.0, check=False)

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file atomically, and create its folders; see the protocol."""
        self.run(command_line.writing(data, target, mode), timeout=timeout)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """Make the folder ``target`` on the machine equal to ``source``; see the protocol."""
        return sync.to_machine(
            self, source, target, excludes=excludes, includes=includes, timeout=timeout,
            cancel=cancel, on_progress=on_progress)

    def open(self, command: Command) -> Stream:
        """Start a program on the machine; closing the returned stream ends the program."""
        channel = self.start(command_line.remote_line(command, user=self.user), _ATTEMPT)
        _feed(channel, command.input, end=False)
        channel.settimeout(None)
        return LineStream(channel, self.name, functools.partial(_take_errors, channel))

    def interactive(self, command: Optional[Command] = None) -> int:
        """Connect the user's terminal to the login shell, or to ``command``."""
        import paramiko

        channel, there = self.channel(), terminal.size()
        try:
            if there is not None:
                rows, columns, kind = there
                channel.get_pty(kind, columns, rows)
            if command is None:
                channel.invoke_shell()
            else:
                channel.exec_command(command_line.remote_line(command, user=self.user))
        except (paramiko.SSHException, OSError) as error:
            channel.close()
            raise ConnectError(f"'{self.name}' gives no terminal: {error}") from error
        return terminal.attach(channel, keys=there is not None)


class _Announced(Output):
    """The output of a command whose first line is its process id, see ``announced_line``."""

    _head: Optional[bytes] = b''
    pid = 0

    def add(self, out: bytes = b'', err: bytes = b'') -> None:
        """Add new standard output and standard error."""
        if self._head is not None:
            first, newline, out = (self._head + out).partition(b'\n')
            self._head = None if newline else first
            if newline and first.isdigit():
                self.pid = int(first)
        super().add(out, err)


def _take_errors(channel: paramiko.Channel) -> bytes:
    """Return the standard error that has arrived."""
    parts = []
    while channel.recv_stderr_ready():
        parts.append(channel.recv_stderr(1 << 16))
    return b''.join(parts)


def _what(command: Command) -> str:
    return command.what or command.argv[0]


def _feed(
    channel: paramiko.Channel, data: bytes, *, end: bool = True,
) -> Optional[threading.Thread]:
    def send() -> None:
        rest = memoryview(data)
        try:
            while rest:
                # The time-out belongs to the channel, but is meant only for reads.
                with contextlib.suppress(TimeoutError):
                    rest = rest[channel.send(bytes(rest[:1 << 15])):]
            if end:
                channel.shutdown_write()
        except (OSError, EOFError):
            pass  # the command ended before it read all input; its exit status has the reason

    if len(data) <= _INLINE:
        send()
        return None
    thread = threading.Thread(target=send, name='fog-feed', daemon=True)
    thread.start()
    return thread


def _pause(channel: paramiko.Channel, until: float) -> None:
    """Wait a little for the exit status, which may arrive after the end of the output."""
    channel.status_event.wait(max(0.0, until - time.monotonic()))
