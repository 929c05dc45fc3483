# SPDX-License-Identifier: Apache-2.0
"""
Run on a machine, and multiplex many commands over one connection: its standard streams.

In a pod it runs as root: each ``exec`` takes a tenth of a second, and cannot end a command's
input, so one ``exec`` runs this program. On another robot's machine it runs as an account there.
It runs commands on request, and ends with the connection. It uses only the standard library; the
robot sends its source.

Frames in both directions: type, channel, length, payload.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pwd
import queue
import select
import signal
import struct
import subprocess
import termios
import threading
import time

TYPE_CHECKING = False  # importing it from typing would delay each pod
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any, IO

HEADER = struct.Struct('>BII')
OUT, ERR, EXIT, OPEN, IN, CLOSE, WINDOW, RESIZE = range(1, 9)
#: Frames of the connection, without a channel.
HELLO, PING, PONG, GONE = range(64, 68)
#: Maximum unacknowledged bytes of a channel's input.
CREDIT = 4 << 20
CHUNK = 1 << 14
#: Maximum size of a frame's payload, so that the other side cannot fill the memory.
LARGEST = 16 << 20
#: Seconds of silence after which the connection counts as lost.
SILENCE = 60.0
_STDIN, _STDOUT = 0, 1


class Process:
    """
    A command; each of its streams has a thread.

    :param streams: our ends of its output streams, with their frame types.
    """

    def __init__(
        self, number: int, child: subprocess.Popen[bytes], stdin: IO[Any],
        streams: dict[IO[Any], int], credit: int, terminal: bool,
    ) -> None:
        self.number = number
        self.child = child
        self.stdin = stdin
        self.streams = streams
        self.terminal = terminal
        #: Input to write; None closes the command's standard input.
        self.input: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        #: Bytes of output that the robot takes.
        self.credit = credit
        self.closed = False
        self.changed = threading.Condition()

    def signal(self, name: signal.Signals) -> None:
        """Send a signal to the command's process group, if the command runs."""
        if self.child.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.child.pid, name)


class Multiplexer:
    """The commands of one connection."""

    def __init__(self) -> None:
        self.processes: dict[int, Process] = {}
        self.sending = threading.Lock()
        self.connected = True

    def run(self) -> None:
        """Serve until the connection ends, then end all commands."""
        self.send(HELLO, 0)
        incoming = bytearray()
        while self.connected and select.select([_STDIN], [], [], SILENCE)[0]:
            data = os.read(_STDIN, 1 << 18)
            if not data:
                break
            incoming += data
            for received in frames(incoming):
                self.take(*received)
        running = list(self.processes.values())
        for name in (signal.SIGTERM, signal.SIGKILL):
            for process in running:
                process.signal(name)
            until = time.monotonic() + 0.5
            while any(p.child.returncode is None for p in running) and time.monotonic() < until:
                time.sleep(0.01)

    def send(self, kind: int, number: int, payload: bytes = b'') -> None:
        """Send a frame; without effect on a lost connection, which ``run`` notices."""
        data = frame(kind, number, payload)
        with self.sending, contextlib.suppress(OSError):
            while data:
                data = data[os.write(_STDOUT, data):]

    def take(self, kind: int, number: int, payload: bytes) -> None:
        """Process a frame from the robot."""
        process = self.processes.get(number)
        if kind == OPEN:
            self.open(number, json.loads(payload))
        elif kind == PING:
            self.send(PONG, 0)
        elif kind == GONE:
            self.connected = False
        elif process is None:
            pass  # the command was closed meanwhile
        elif kind == IN:
            if payload or not process.terminal:  # a terminal's end of input is a character
                process.input.put(payload or None)
        elif kind == WINDOW:
            with process.changed:
                process.credit += struct.unpack('>I', payload)[0]
                process.changed.notify_all()
        elif kind == RESIZE:
            rows, columns = struct.unpack('>HH', payload)
            with contextlib.suppress(OSError, ValueError):  # the command has ended
                resize(process.stdin.fileno(), rows, columns)
        elif kind == CLOSE:
            self.close(process)

    def open(self, number: int, what: dict[str, Any]) -> None:
        """Start a command."""
        try:
            process = begin(number, what)
        except (OSError, KeyError, ValueError, subprocess.SubprocessError) as error:
            missing = isinstance(error, FileNotFoundError)
            text = 'command not found' if missing else str(error)
            name = (what['argv'] or ['login shell'])[0]
            self.send(ERR, number, f'{name}: {text}\n'.encode())
            self.send(OUT, number)
            self.send(ERR, number)
            self.send(EXIT, number, struct.pack('>i', 127 if missing else 126))
            return
        self.processes[number] = process
        if process.terminal:
            self.send(ERR, number)  # a terminal has only one output stream
        for stream, kind in process.streams.items():
            threading.Thread(target=self.output, args=(process, stream, kind), daemon=True).start()
        for call in (self.feed, self.wait):
            threading.Thread(target=call, args=(process,), daemon=True).start()

    def output(self, process: Process, stream: IO[Any], kind: int) -> None:
        """Forward an output stream of a command, as fast as the robot reads it."""
        data = b' '
        while data:
            with process.changed:
                process.changed.wait_for(lambda: process.credit > 0 or process.closed)
            try:
                data = stream.read(CHUNK)
            except OSError:
                data = b''  # the terminal has no more users
            with process.changed:
                process.credit -= len(data)
            if not process.closed:
                self.send(kind, process.number, data)
        stream.close()

    def feed(self, process: Process) -> None:
        """Write input to a command, as fast as the command reads it."""
        # The command may close its input; its exit status has the reason.
        with contextlib.suppress(OSError):
            while (data := process.input.get()) is not None:
                rest = data
                while rest:
                    rest = rest[process.stdin.write(rest):]
                self.send(WINDOW, process.number, struct.pack('>I', len(data)))
        with contextlib.suppress(OSError):
            process.stdin.close()

    def wait(self, process: Process) -> None:
        """Report the exit of a command."""
        code = process.child.wait()
        # A signal becomes an exit status as in a shell.
        self.send(EXIT, process.number, struct.pack('>i', code if code >= 0 else 128 - code))
        process.input.put(None)
        self.forget(process)

    def close(self, process: Process) -> None:
        """Stop to forward a command's output, and end the command if it still runs."""
        with process.changed:
            process.closed = True
            process.changed.notify_all()
        if process.child.returncode is None:
            # Intentional background processes have their own process groups, and stay.
            process.signal(signal.SIGTERM)
            killer = threading.Timer(2.0, process.signal, (signal.SIGKILL,))
            killer.daemon = True
            killer.start()
        self.forget(process)

    def forget(self, process: Process) -> None:
        """Forget a command that is closed and has exited."""
        if process.closed and process.child.returncode is not None:
            self.processes.pop(process.number, None)


def frame(kind: int, number: int, payload: bytes) -> bytes:
    """Serialise a frame."""
    return HEADER.pack(kind, number, len(payload)) + payload


def frames(incoming: bytearray) -> Iterator[tuple[int, int, bytes]]:
    """
    Remove the complete frames at the start of a buffer, and yield them.

    :raises ValueError: the buffer does not start with a frame.
    """
    while len(incoming) >= HEADER.size:
        kind, number, size = HEADER.unpack_from(incoming)
        end = HEADER.size + size
        if size > LARGEST:
            raise ValueError(f'a frame of {size} bytes')
        if len(incoming) < end:
            return
        payload = bytes(incoming[HEADER.size:end])
        del incoming[:end]
        yield kind, number, payload


def resize(terminal: int, rows: int, columns: int) -> None:
    """Set the size of a terminal, in characters."""
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack('HHHH', rows, columns, 0, 0))


def begin(number: int, what: dict[str, Any]) -> Process:
    """Start a command."""
    user = pwd.getpwnam('root' if what['root'] else what['user'])
    environment = {
        **os.environ, 'HOME': user.pw_dir, 'USER': user.pw_name, 'LOGNAME': user.pw_name,
        'SHELL': user.pw_shell or '/bin/sh', **what['env']}
    if user.pw_uid != os.geteuid():
        # Announces that commands can become root without sudo.
        environment['FOGROS2_ROOT'] = 'yes'
    options: dict[str, Any] = {
        'env': environment, 'cwd': user.pw_dir if os.path.isdir(user.pw_dir) else '/',
        'start_new_session': True, 'bufsize': 0}
    if user.pw_uid != os.geteuid():
        options.update(user=user.pw_uid, group=user.pw_gid,
                       extra_groups=os.getgrouplist(user.pw_name, user.pw_gid))
    argv = what['argv'] or [environment['SHELL'], '-l']
    if not what['pty']:
        child = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
        assert child.stdin and child.stdout and child.stderr
        return Process(
            number, child, child.stdin, {child.stdout: OUT, child.stderr: ERR}, what['credit'],
            terminal=False)
    outer, inner = os.openpty()
    with open(inner, 'rb', buffering=0), contextlib.ExitStack() as undo:
        undo.callback(os.close, outer)
        rows, columns, environment['TERM'] = what['pty']
        resize(inner, rows, columns)
        os.fchown(inner, user.pw_uid, user.pw_gid)
        child = subprocess.Popen(
            argv, stdin=inner, stdout=inner, stderr=inner,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0), **options)
        undo.pop_all()
    screen = open(os.dup(outer), 'rb', buffering=0)
    return Process(number, child, open(outer, 'wb', buffering=0), {screen: OUT}, what['credit'],
                   terminal=True)


if __name__ == '__main__':
    os.chdir('/')
    os.umask(0o022)
    for descriptor in (_STDIN, _STDOUT):
        os.set_blocking(descriptor, True)
    Multiplexer().run()
