# SPDX-License-Identifier: Apache-2.0
"""
Run commands in a pod through the API server: the image needs no SSH server, the pod no open port.

One ``exec`` carries all commands (see ``kubernetes_mux``), so a command takes one round trip.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from pathlib import Path
import threading
import time
from typing import Optional

from fogros2.errors import (
    Cancelled,
    ConnectError,
    DeadlineExceeded,
    FogError,
)
from fogros2.model import Command, Endpoint, Result, SyncReport
from fogros2.shell import command_line, Stream, sync, terminal
from fogros2.shell.kubernetes_channel import Channel
from fogros2.shell.kubernetes_link import Link
from fogros2.shell.lines import LineStream, Output
from fogros2.waiting import cancellable, wait_until

#: Seconds to wait for further output after a command's end, as its children may still write.
_DRAIN = 2.0
#: Largest input in bytes that fits into a channel's window, and needs no thread.
_INLINE = 1 << 20
#: Time-out of one attempt to connect, in seconds.
_ATTEMPT = 10.0


class KubernetesShell:
    """
    A Shell for endpoints of kind 'kubernetes', whose host is ``namespace/pod@context``.

    :param name: the machine's name, for messages.
    :param timeout: seconds for which to try to connect.
    """

    @staticmethod
    def warm() -> None:
        """Start to import the client; see :func:`fogros2.shell.warm`."""
        threading.Thread(target=_load, name='fog-load', daemon=True).start()

    def __init__(self, endpoint: Endpoint, *, name: str, timeout: float = 30.0) -> None:
        self.endpoint = endpoint
        self.name = name
        self.user = endpoint.user or 'root'
        self._timeout = timeout
        self._lock = threading.Lock()
        self._link: Optional[Link] = None
        # Only one thread connects at a time; close() does not wait for this lock.
        self._connecting = threading.Lock()
        self._closings = 0

    # -- connection -----------------------------------------------------------------------------

    def _connected(
        self, timeout: float, cancel: Optional[threading.Event] = None,
    ) -> Link:
        """Return the connection; open it if necessary, and wait for a restarting API server."""
        until = time.monotonic() + min(self._timeout, timeout)
        link, _ = self._known()
        if link is not None:
            return link
        try:
            wait_until(lambda: self._connecting.acquire(timeout=0.05), interval=0.0,
                       timeout=until - time.monotonic(), cancel=cancel,
                       what=f"a connection to '{self.name}'")
        except DeadlineExceeded as error:
            raise ConnectError(f"'{self.name}' can't be reached: nothing has answered in time",
                               "check the robot's network") from error
        try:
            link, closings = self._known()
            if link is not None:
                return link
            link = self._connect(max(0.5, until - time.monotonic()), cancel)
            with self._lock:
                if closings == self._closings:
                    self._link = link
                    return link
            link.close()
            raise ConnectError(f"the connection to '{self.name}' was closed while it came up")
        finally:
            self._connecting.release()

    def _known(self) -> tuple[Optional[Link], int]:
        """Return the connection if it is alive, and the number of calls of close()."""
        with self._lock:
            link = self._link
            return link if link is not None and link.alive else None, self._closings

    def _connect(self, patience: float, cancel: Optional[threading.Event]) -> Link:
        last: list[FogError] = []

        def attempt() -> Optional[Link]:
            try:
                return cancellable(
                    lambda: Link(self.endpoint, name=self.name, timeout=min(patience, _ATTEMPT)),
                    cancel, what=f"connecting to '{self.name}'", late=Link.close)
            except (ConnectError, DeadlineExceeded) as error:
                last[:] = [error]
                return None

        try:
            return wait_until(attempt, timeout=patience, interval=0.1, cancel=cancel,
                              what=f"a connection to '{self.name}'")
        except DeadlineExceeded as error:
            raise last[0] if last else error from error

    def _open(
        self, command: Command, timeout: float, cancel: Optional[threading.Event] = None,
    ) -> Channel:
        for attempt in (1, 2):
            link = self._connected(timeout, cancel)
            try:
                return link.open(command)
            except ConnectError:
                # The connection was lost before, so the command has not started: retry once.
                if attempt == 2:
                    raise
        raise AssertionError('the second attempt returns or raises')

    def close(self) -> None:
        """Close the connection; the next call opens a new one."""
        with self._lock:
            link, self._link = self._link, None
            self._closings += 1
        if link is not None:
            link.close()

    # -- commands -------------------------------------------------------------------------------

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Run a command in the pod, and wait for its end; see the protocol."""
        begin = time.monotonic()
        what = command.what or command.argv[0]
        if cancel is not None and cancel.is_set():
            raise Cancelled(what)
        output = Output(on_output)
        with contextlib.closing(self._open(command, timeout, cancel)) as channel:
            feeder = _feed(channel, command.input)
            self._collect(channel, output, begin + timeout, cancel, what)
            returncode = channel.exit_status
            if feeder is not None:
                feeder.join(_DRAIN)
        if returncode is None:
            raise ConnectError(f"the connection to '{self.name}' was lost while {what} ran there",
                               "check the robot's network")
        result = Result(returncode, *output.text(), time.monotonic() - begin)
        return command_line.checked(command, result, f"'{self.name}'") if check else result

    def _collect(
        self, channel: Channel, output: Output, deadline: float,
        cancel: Optional[threading.Event], what: str,
    ) -> None:
        """Read until both streams and the command have ended, or the time is up."""
        quiet_since = 0.0
        while True:
            now = time.monotonic()
            if cancel is not None and cancel.is_set():
                raise Cancelled(what)
            if now >= deadline:
                raise DeadlineExceeded(f"{what} took too long on '{self.name}'")
            try:
                out, err, ended = channel.read(min(0.05, deadline - now))
            except ConnectError as error:
                raise ConnectError(
                    f"the connection to '{self.name}' was lost while {what} ran there: "
                    f'{error.args[0]}', error.hint or "check the robot's network") from error
            output.add(out, err)
            if ended:
                if channel.wait_exit(min(0.05, deadline - now)):
                    return
            elif out or err:
                quiet_since = 0.0
            elif channel.exit_status is not None:
                # The command has ended, but its background processes hold its output open.
                quiet_since = quiet_since or now
                if now - quiet_since >= _DRAIN:
                    return

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file atomically, and create its folders; see the protocol."""
        self.run(command_line.writing(data, target, mode), timeout=timeout)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """Make the folder ``target`` in the pod equal to ``source``; see the protocol."""
        return sync.to_machine(
            self, source, target, excludes=excludes, includes=includes, timeout=timeout,
            cancel=cancel, on_progress=on_progress)

    def start(self, line: str) -> Channel:
        """
        Start a command line in the pod, and return its channel.

        :raises ConnectError: the pod cannot be reached.
        """
        return self._open(Command(('sh', '-c', line)), self._timeout)

    def open(self, command: Command) -> Stream:
        """Start a program in the pod; closing the returned stream ends the program."""
        channel = self._open(command, self._timeout)
        stream = LineStream(channel, self.name, channel.discard_errors)
        if command.input:
            stream.write(command.input)
        return stream

    def interactive(self, command: Optional[Command] = None) -> int:
        """Connect the user's terminal to the login shell, or to ``command``."""
        there = terminal.size()
        channel = self._connected(self._timeout).open(
            command or Command(()), terminal=there, login=command is None)
        return terminal.attach(channel, keys=there is not None)


def _load() -> None:
    with contextlib.suppress(FogError, ImportError):
        from fogros2 import kubernetes_client
        kubernetes_client.connect()
        import websocket  # noqa: F401


def _feed(channel: Channel, data: bytes) -> Optional[threading.Thread]:
    def send() -> None:
        with contextlib.suppress(OSError, FogError):
            # The command may end before it reads all input; its exit status has the reason.
            channel.sendall(data)
            channel.shutdown_write()

    if len(data) <= _INLINE:
        send()
        return None
    thread = threading.Thread(target=send, name='fog-feed', daemon=True)
    thread.start()
    return thread
