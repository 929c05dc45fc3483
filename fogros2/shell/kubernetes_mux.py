# SPDX-License-Identifier: Apache-2.0
"""
Run in a pod as root, and multiplex many commands over the stream of one ``exec``.

Each ``exec`` takes a tenth of a second, and cannot end a command's input. So one ``exec`` runs
this program. The program runs commands on request, and ends with the connection. It uses only the
standard library; the robot sends its source over its standard input.

Frames in both directions: type, channel, length, payload.
"""

from __future__ import annotations

import collections
from collections.abc import Callable
import contextlib
import fcntl
import functools
import json
import os
import pwd
import selectors
import signal
import struct
import subprocess
import termios
import time

TYPE_CHECKING = False  # importing it from typing would delay each pod
if TYPE_CHECKING:
    from typing import Any

HEADER = struct.Struct('>BII')
OUT, ERR, EXIT, OPEN, IN, CLOSE, WINDOW, RESIZE = range(1, 9)
#: Frames of the connection, without a channel.
HELLO, PING, PONG, GONE = range(64, 68)
#: Maximum unacknowledged bytes of a channel in each direction.
CREDIT = 4 << 20
CHUNK = 1 << 15
#: Seconds of silence after which the connection counts as lost.
SILENCE = 60.0
_STDIN, _STDOUT = 0, 1


class Process:
    """A command, and our ends of its streams."""

    def __init__(
        self, number: int, child: subprocess.Popen[bytes], stdin: int, streams: dict[int, int],
        terminal: bool,
    ) -> None:
        self.number = number
        self.child = child
        self.stdin = stdin
        self.terminal = terminal
        #: Frame type by file descriptor.
        self.streams = streams
        self.waiting: collections.deque[bytes] = collections.deque()
        self.credit = CREDIT
        self.paused = False
        self.exited = False
        self.killed_at = 0.0

    def signal(self, name: signal.Signals) -> None:
        """Send a signal to the command's process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.child.pid, name)


class Multiplexer:
    """The commands of one connection."""

    def __init__(self) -> None:
        self.selector = selectors.DefaultSelector()
        self.processes: dict[int, Process] = {}
        self.ending: list[Process] = []
        self.connected = True
        self.incoming = bytearray()
        self.outgoing: collections.deque[bytes] = collections.deque()
        self.heard = time.monotonic()
        self.woken, wake = os.pipe()
        for stream in (wake, self.woken, _STDIN, _STDOUT):
            os.set_blocking(stream, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self.listen_to(self.woken, self.reap)
        self.listen_to(_STDIN, self.read)
        self.send(HELLO, 0)

    def listen_to(self, stream: int, call: Callable[[], None]) -> None:
        """Register a function to call when a stream is readable."""
        self.selector.register(stream, selectors.EVENT_READ, call)

    def run(self) -> None:
        """Serve until the connection ends, then end all commands."""
        while self.connected and time.monotonic() - self.heard < SILENCE:
            for key, _ in self.selector.select(1.0):
                if key.fileobj in self.selector.get_map():
                    key.data()
            for process in self.ending:
                if not process.exited and time.monotonic() - process.killed_at > 2.0:
                    process.signal(signal.SIGKILL)
            self.ending = [p for p in self.ending if not p.exited]
        left = (*self.processes.values(), *self.ending)
        for name in (signal.SIGTERM, signal.SIGKILL) if left else ():
            for process in left:
                process.signal(name)
            time.sleep(0.5)

    # -- the connection -------------------------------------------------------------------------

    def read(self) -> None:
        """Read frames from the robot, and process them."""
        try:
            data = os.read(_STDIN, 1 << 18)
        except BlockingIOError:
            return
        except OSError:
            data = b''
        if not data:
            self.connected = False
            return
        self.heard = time.monotonic()
        self.incoming += data
        while len(self.incoming) >= HEADER.size:
            kind, number, size = HEADER.unpack_from(self.incoming)
            end = HEADER.size + size
            if len(self.incoming) < end:
                break
            payload = bytes(self.incoming[HEADER.size:end])
            del self.incoming[:end]
            self.take(kind, number, payload)

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
            process.waiting.append(payload)
            self.feed(process)
        elif kind == WINDOW:
            process.credit += struct.unpack('>I', payload)[0]
            if process.paused and process.credit > 0:
                self.listen(process)
        elif kind == RESIZE:
            rows, columns = struct.unpack('>HH', payload)
            with contextlib.suppress(OSError):
                fcntl.ioctl(process.stdin, termios.TIOCSWINSZ,
                            struct.pack('HHHH', rows, columns, 0, 0))
        elif kind == CLOSE:
            self.close(process)

    def send(self, kind: int, number: int, payload: bytes = b'') -> None:
        """Send a frame."""
        self.outgoing.append(frame(kind, number, payload))
        self.want_write()

    def want_write(self) -> None:
        """Write as much as possible, and the rest when the connection is writable again."""
        try:
            while self.outgoing:
                data = self.outgoing[0]
                count = os.write(_STDOUT, data)
                if count < len(data):
                    self.outgoing[0] = data[count:]
                    continue
                self.outgoing.popleft()
        except BlockingIOError:
            with contextlib.suppress(KeyError):
                self.selector.register(_STDOUT, selectors.EVENT_WRITE, self.want_write)
            return
        except OSError:
            self.connected = False
            return
        with contextlib.suppress(KeyError, ValueError):
            self.selector.unregister(_STDOUT)

    # -- commands -------------------------------------------------------------------------------

    def open(self, number: int, what: dict[str, Any]) -> None:
        """Start a command."""
        try:
            process = begin(number, what)
        except (OSError, KeyError, ValueError, subprocess.SubprocessError) as error:
            missing = isinstance(error, FileNotFoundError)
            text = 'command not found' if missing else str(error)
            self.send(ERR, number, f"{what['argv'][0]}: {text}\n".encode())
            self.send(OUT, number)
            self.send(ERR, number)
            self.send(EXIT, number, struct.pack('>i', 127 if missing else 126))
            return
        self.processes[number] = process
        if process.terminal:
            self.send(ERR, number)  # a terminal has only one output stream
        self.listen(process)

    def listen(self, process: Process) -> None:
        """Start to read a command's output."""
        process.paused = False
        for stream in process.streams:
            self.listen_to(stream, functools.partial(self.output, process, stream))

    def output(self, process: Process, stream: int) -> None:
        """Forward a command's output."""
        kind = process.streams[stream]
        try:
            data = os.read(stream, CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b''  # the terminal has no more users
        self.send(kind, process.number, data)
        if not data:
            self.selector.unregister(stream)
            del process.streams[stream]
            os.close(stream)
            self.finish(process)
            return
        process.credit -= len(data)
        if process.credit <= 0:
            process.paused = True
            for each in process.streams:
                self.selector.unregister(each)

    def feed(self, process: Process) -> None:
        """Write waiting input to a command as far as the command reads it."""
        stdin = process.stdin
        if stdin < 0:
            process.waiting.clear()
            return
        taken = 0
        try:
            while process.waiting and process.waiting[0]:
                data = process.waiting[0]
                count = os.write(stdin, data)
                taken += count
                if count < len(data):
                    process.waiting[0] = data[count:]
                else:
                    process.waiting.popleft()
            done = bool(process.waiting)
        except BlockingIOError:
            with contextlib.suppress(KeyError):
                self.selector.register(
                    stdin, selectors.EVENT_WRITE, functools.partial(self.feed, process))
            if taken:
                self.send(WINDOW, process.number, struct.pack('>I', taken))
            return
        except OSError:
            done = True  # the command closed its input; its exit status has the reason
        if taken:
            self.send(WINDOW, process.number, struct.pack('>I', taken))
        with contextlib.suppress(KeyError):
            self.selector.unregister(stdin)
        if done and not process.terminal:  # a terminal's end of input is a character
            process.stdin = -1
            process.waiting.clear()
            os.close(stdin)

    def reap(self) -> None:
        """Record the commands that have exited."""
        with contextlib.suppress(BlockingIOError):
            os.read(self.woken, 4096)
        for process in (*self.processes.values(), *self.ending):
            if not process.exited and process.child.poll() is not None:
                process.exited = True
                if process.number in self.processes:
                    code = process.child.returncode
                    # A signal becomes an exit status as in a shell.
                    self.send(EXIT, process.number,
                              struct.pack('>i', code if code >= 0 else 128 - code))
                    self.finish(process)

    def finish(self, process: Process) -> None:
        """Close a command that has exited and whose streams have ended."""
        if process.exited and not process.streams:
            self.close(process)

    def close(self, process: Process) -> None:
        """Close a command's streams, and end the command if it still runs."""
        del self.processes[process.number]
        for stream in (*process.streams, *([process.stdin] if process.stdin >= 0 else [])):
            with contextlib.suppress(KeyError):
                self.selector.unregister(stream)
            os.close(stream)
        process.streams = {}
        process.stdin = -1
        # Intentional background processes have their own process groups, and stay.
        if not process.exited:
            process.signal(signal.SIGTERM)
            process.killed_at = time.monotonic()
            self.ending.append(process)


def frame(kind: int, number: int, payload: bytes) -> bytes:
    """Serialise a frame."""
    return HEADER.pack(kind, number, len(payload)) + payload


def begin(number: int, what: dict[str, Any]) -> Process:
    """Start a command."""
    user = pwd.getpwnam('root' if what['root'] else what['user'])
    environment = {
        **os.environ, 'HOME': user.pw_dir, 'USER': user.pw_name, 'LOGNAME': user.pw_name,
        'SHELL': user.pw_shell or '/bin/sh', **what['env']}
    if user.pw_uid != 0:
        # Announces that commands can become root without sudo.
        environment['FOGROS2_ROOT'] = 'yes'
    options: dict[str, Any] = {
        'env': environment, 'cwd': user.pw_dir if os.path.isdir(user.pw_dir) else '/',
        'start_new_session': True, 'restore_signals': True}
    if user.pw_uid != os.geteuid():
        options.update(user=user.pw_uid, group=user.pw_gid,
                       extra_groups=os.getgrouplist(user.pw_name, user.pw_gid))
    argv = what['argv'] or [environment['SHELL'], '-l']
    stdin: int
    if not what['pty']:
        child = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
        assert child.stdin and child.stdout and child.stderr
        stdin, out, err = (os.dup(s.fileno()) for s in (child.stdin, child.stdout, child.stderr))
        child.stdin.close()
        child.stdout.close()
        child.stderr.close()
        streams = {out: OUT, err: ERR}
    else:
        stdin, inner = os.openpty()
        rows, columns, environment['TERM'] = what['pty']
        fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack('HHHH', rows, columns, 0, 0))
        os.fchown(inner, user.pw_uid, user.pw_gid)

        def take_terminal() -> None:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        try:
            child = subprocess.Popen(argv, stdin=inner, stdout=inner, stderr=inner,
                                     preexec_fn=take_terminal, **options)
        except BaseException:
            os.close(stdin)
            raise
        finally:
            os.close(inner)
        streams = {os.dup(stdin): OUT}
    for stream in (stdin, *streams):
        os.set_blocking(stream, False)
    return Process(number, child, stdin, streams, bool(what['pty']))


if __name__ == '__main__':
    os.chdir('/')
    os.umask(0o022)
    Multiplexer().run()
