# SPDX-License-Identifier: Apache-2.0
"""Run commands over one connection with many channels, which is opened again after a loss."""

from __future__ import annotations

import abc
from collections.abc import Callable
import contextlib
import getpass
import threading
import time
from typing import Generic, Optional, TYPE_CHECKING, TypeVar

from fogros2.errors import Cancelled, ConnectError, DeadlineExceeded, FogError
from fogros2.model import Command, Endpoint, Result
from fogros2.shell import command_line, lines, relay, Stream, sync, terminal
from fogros2.shell.lines import Channel, LineStream, Output, take_errors
from fogros2.waiting import cancellable, noted, wait_until

if TYPE_CHECKING:
    import paramiko

    from fogros2.shell import multiplexed

#: Seconds to wait for further output after a command's end, as its children may still write.
_DRAIN = 2.0

#: A connection with many channels.
Link = TypeVar('Link', 'paramiko.Transport', 'multiplexed.Link')


class RemoteShell(sync.RsyncShell, Generic[Link]):
    """
    A Shell for endpoints of one kind; a subclass opens connections and channels.

    :param name: the machine's name, for messages.
    :param timeout: seconds for which to try to connect.
    """

    #: Whether to end the input of a command that gets none; else its command line does that.
    ends_empty_input = True

    def __init__(self, endpoint: Endpoint, *, name: str, timeout: float = 30.0) -> None:
        self.endpoint = endpoint
        self.name = name
        self.where = f"'{name}'"
        self.user = endpoint.user or getpass.getuser()
        self._timeout = timeout
        self._lock = threading.Lock()
        self._connection: Optional[Link] = None
        # Only one thread connects at a time; close() does not wait for this lock.
        self._connecting = threading.Lock()
        self._closings = 0

    @abc.abstractmethod
    def _connect(self, timeout: float, cancel: Optional[threading.Event]) -> Link:
        """
        Open a connection, in a thread that a cancel abandons.

        :param cancel: ends the thread between two attempts.
        :raises ConnectError: the machine cannot be reached.
        """

    @abc.abstractmethod
    def _start(
        self, connection: Link, command: Command | str | None, timeout: float,
        cancel: Optional[threading.Event] = None, size: Optional[tuple[int, int, str]] = None,
    ) -> Channel:
        """
        Start a command or a command line; a lost connection is closed before the error.

        :param command: None: start the login shell.
        :param size: of the command's terminal, see ``terminal.size``; None: no terminal.
        :raises ConnectError: the connection is lost, or gives no channel.
        """

    def _abandon(self, command: Command, channel: Channel, output: Output) -> None:
        """End a command whose channel is open, if closing the channel does not end it."""

    def _announced(self, command: Command) -> Command | str:
        """Return a command in the form whose output starts with what ``_abandon`` needs."""
        return command

    # -- connection -----------------------------------------------------------------------------

    def _connected(
        self, timeout: float, cancel: Optional[threading.Event] = None,
    ) -> Link:
        """Return the connection; open it if necessary."""
        timeout = min(self._timeout, timeout)
        until = time.monotonic() + timeout
        connection, _ = self._known()
        if connection is not None:
            return connection
        try:
            wait_until(lambda: self._connecting.acquire(timeout=0.05), interval=0.0,
                       timeout=timeout, cancel=cancel, what=f"a connection to '{self.name}'")
        except DeadlineExceeded as error:
            raise ConnectError(
                f"'{self.name}' can not be reached: nothing has answered for {timeout:g} s",
                "check the robot's network") from error
        try:
            connection, closings = self._known()
            if connection is not None:
                return connection
            connection = cancellable(
                lambda: self._connect(max(0.5, until - time.monotonic()), cancel), cancel,
                what=f"connecting to '{self.name}'", grace=lambda: 1.0,
                late=lambda late: late.close())
            with self._lock:
                if closings == self._closings:
                    self._connection = connection
                    return connection
            connection.close()
            raise ConnectError(f"the connection to '{self.name}' was closed while it came up")
        finally:
            self._connecting.release()

    def _known(self) -> tuple[Optional[Link], int]:
        """Return the connection if it is alive, and the number of calls of close()."""
        with self._lock:
            link = self._connection
            return link if link is not None and link.is_alive() else None, self._closings

    def _drop(self, connection: Link) -> None:
        """Close a connection that is lost."""
        with self._lock:
            if self._connection is connection:
                self._connection = None
        connection.close()

    def close(self) -> None:
        """Close the connection; the next call opens a new one."""
        with self._lock:
            connection, self._connection = self._connection, None
            self._closings += 1
        if connection is not None:
            connection.close()

    def start(
        self, command: Command | str, timeout: Optional[float] = None,
        cancel: Optional[threading.Event] = None,
    ) -> Channel:
        """
        Start a command, or a command line, on the machine, and return its channel.

        :param timeout: seconds until it runs, at most the constructor's time-out.
        :raises ConnectError: the machine cannot be reached.
        """
        timeout = min(self._timeout, timeout or self._timeout)
        connection = self._connected(timeout, cancel)
        try:
            return self._start(connection, command, timeout, cancel)
        except ConnectError:
            if self._known()[0] is connection:
                raise
        # The connection was lost before, so the command has not started: retry once.
        return self._start(self._connected(timeout, cancel), command, timeout, cancel)

    # -- commands -------------------------------------------------------------------------------

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Run a command on the machine, and wait for its end; see the protocol."""
        begin = time.monotonic()
        if cancel is not None and cancel.is_set():
            raise Cancelled(_what(command))
        started = self._announced(command)
        channel = self.start(started, timeout, cancel)
        output = Output(on_output, announced=started is not command)
        try:
            feeder = _feed(
                channel, command.input, end=bool(command.input) or self.ends_empty_input)
            # ``_status`` reports a connection that is gone
            with noted(_what(command)), contextlib.suppress(ConnectionError):
                self._collect(channel, output, begin + timeout, cancel, command)
            returncode = self._status(channel, command)
            if feeder is not None:
                feeder.join(_DRAIN)
        except (Cancelled, DeadlineExceeded):
            self._abandon(command, channel, output)
            raise
        finally:
            lines.close(channel)
        result = Result(returncode, *output.text())
        return command_line.checked(command, result, self.where) if check else result

    def _collect(
        self, channel: Channel, output: Output, deadline: float,
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
                if errors := take_errors(channel):
                    output.add(err=errors)
                    quiet_since = 0.0
                elif channel.exit_status_ready():
                    # The command has ended, but its background processes hold its output open.
                    quiet_since = quiet_since or now
                    if now - quiet_since >= _DRAIN:
                        return
                continue
            output.add(data, take_errors(channel))
            quiet_since = 0.0
            if data:
                continue
            # Standard output has ended; standard error ends with the channel.
            channel.settimeout(max(0.05, min(_DRAIN, deadline - now)))
            with contextlib.suppress(TimeoutError):
                while more := channel.recv_stderr(1 << 16):
                    output.add(err=more)
            if channel.exit_status_ready() or not channel.get_transport().is_alive():
                return
            # The exit status may arrive after the end of the output.
            channel.status_event.wait(max(0.0, min(deadline - now, 0.05)))

    def _status(self, channel: Channel, command: Command) -> int:
        if channel.exit_status_ready():
            status = int(channel.recv_exit_status())
            if status != -1 or channel.eof_received:  # with eof, a signal ended the command
                return status
        raise ConnectError(f"the connection to '{self.name}' was lost while "
                           f'{_what(command)} ran there', "check the robot's network")

    def _remote_shell(self) -> contextlib.AbstractContextManager[relay.RemoteShell]:
        return relay.remote_shell(
            lambda line, *streams: relay.relay(self.start(line), *streams))

    def open(self, command: Command) -> Stream:
        """Start a program on the machine; closing the returned stream ends the program."""
        channel = self.start(command_line.quiet(command))
        feeder = _feed(channel, command.input, end=False)
        if feeder is not None:
            feeder.join(self._timeout)
        channel.settimeout(None)
        return LineStream(channel, self.name)

    def interactive(self, command: Optional[Command] = None) -> int:
        """Connect the user's terminal to the login shell, or to ``command``."""
        size = terminal.size()
        channel = self._start(
            self._connected(self._timeout), command, self._timeout, size=size)
        return terminal.attach(channel, keys=size is not None)


def _what(command: Command) -> str:
    return command.what or command.argv[0]


def _feed(channel: Channel, data: bytes, *, end: bool) -> Optional[threading.Thread]:
    def send() -> None:
        rest = memoryview(data)
        # The command may end before it reads all input; its exit status has the reason.
        with contextlib.suppress(OSError, FogError):
            while rest:
                # The time-out belongs to the channel, but is meant only for reads.
                with contextlib.suppress(TimeoutError):
                    rest = rest[channel.send(bytes(rest[:1 << 15])):]
            if end:
                channel.shutdown_write()

    if not data:
        send()
        return None
    thread = threading.Thread(target=send, name='fog-feed', daemon=True)
    thread.start()
    return thread


class MultiplexedShell(RemoteShell['multiplexed.Link']):
    """A Shell whose commands share one connection to a multiplexer; a subclass connects."""

    def _start(
        self, connection: multiplexed.Link, command: Command | str | None, timeout: float,
        cancel: Optional[threading.Event] = None, size: Optional[tuple[int, int, str]] = None,
    ) -> Channel:
        return connection.open(
            Command(('sh', '-c', command)) if isinstance(command, str) else command, size)
