# SPDX-License-Identifier: Apache-2.0
"""
Runs in a pod, as root: many commands over the one stream that ``exec`` gives.

``exec`` takes a tenth of a second each time, knows no end of input, and ends with the API server's
connection. So one ``exec`` begins this program, whose daemon runs commands as asked and outlives
the connection for a minute: the next ``exec`` hands its streams over, and what was under way
goes on where it was. Standard library alone; its source comes over its standard input.

Frames, both ways: type, channel, length, payload. Those below ``CONTROL`` are counted, and kept
until the other side says that it has them.
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
import socket
import struct
import subprocess
import sys
import termios
import time

TYPE_CHECKING = False  # each pod would wait for typing itself
if TYPE_CHECKING:
    from typing import Any, NoReturn

HEADER = struct.Struct('>BII')
# counted
OUT, ERR, EXIT, OPEN, IN, CLOSE, WINDOW, RESIZE = range(1, 9)
# not counted
CONTROL = 64
HELLO, ACK, PING, PONG, GONE = range(64, 69)
#: Bytes that may be under way on a channel, each way.
CREDIT = 4 << 20
CHUNK = 1 << 15
#: Seconds without a word after which a connection counts as lost.
SILENCE = 60.0
#: Seconds for which commands outlive a lost connection.
OUTLIVE = 60.0
#: Counted bytes after which their arrival is acknowledged.
ACK_EVERY = 1 << 18


class Process:
    """A command and the ends of its streams."""

    def __init__(
        self, number: int, child: subprocess.Popen[bytes], stdin: int, streams: dict[int, int],
        terminal: bool,
    ) -> None:
        self.number = number
        self.child = child
        self.stdin = stdin
        self.terminal = terminal
        #: Descriptor -> type of its frames.
        self.streams = streams
        self.waiting: collections.deque[bytes] = collections.deque()
        self.credit = CREDIT
        self.paused = False
        self.exited = False
        self.killed_at = 0.0

    def signal(self, name: signal.Signals) -> None:
        """Signal the process and what it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.child.pid, name)


class Daemon:
    """The commands of one session, and its connection while there is one."""

    def __init__(self, listener: socket.socket) -> None:
        self.listener = listener
        self.selector = selectors.DefaultSelector()
        self.listen_to(listener, self.accept)
        self.processes: dict[int, Process] = {}
        self.ending: list[Process] = []
        self.link: socket.socket | None = None
        self.source = self.sink = -1
        self.incoming = bytearray()
        self.outgoing: collections.deque[bytes] = collections.deque()
        self.kept: collections.deque[bytes] = collections.deque()
        self.sent = self.received = self.unacked = 0
        #: Whether the other side has said what it has, so that it gets what it hasn't.
        self.greeted = False
        self.heard = time.monotonic()
        self.woken, wake = os.pipe()
        os.set_blocking(wake, False)
        os.set_blocking(self.woken, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self.listen_to(self.woken, self.reap)

    def listen_to(self, stream: socket.socket | int, call: Callable[[], None]) -> None:
        """Have something called when there is something to read."""
        self.selector.register(stream, selectors.EVENT_READ, call)

    def run(self) -> None:
        """Serve until the session has ended, or nobody came back to it."""
        while True:
            for key, _ in self.selector.select(1.0):
                if key.fileobj in self.selector.get_map():
                    key.data()
            now = time.monotonic()
            if self.link is not None and now - self.heard > SILENCE:
                self.drop()
            if self.link is None and now - self.heard > OUTLIVE:
                break
            for process in self.ending:
                if not process.exited and now - process.killed_at > 2.0:
                    process.signal(signal.SIGKILL)
            self.ending = [p for p in self.ending if not p.exited]
        for name in (signal.SIGTERM, signal.SIGKILL):
            for process in (*self.processes.values(), *self.ending):
                process.signal(name)
            time.sleep(0.5)

    # -- the connection -------------------------------------------------------------------------

    def accept(self) -> None:
        """Take the streams that an ``exec`` hands over."""
        link, _ = self.listener.accept()
        peer = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize('3i'))
        _, streams, _, _ = socket.recv_fds(link, 1, 2)
        if struct.unpack('3i', peer)[1] != os.geteuid() or len(streams) != 2:
            for stream in streams:
                os.close(stream)
            link.close()
            return
        self.drop()
        self.link = link
        self.source, self.sink = streams
        for stream in streams:
            os.set_blocking(stream, False)
        self.heard = time.monotonic()
        self.listen_to(self.source, self.read)
        hello = {'received': self.received, 'python': sys.version.split()[0]}
        self.outgoing.append(frame(HELLO, 0, json.dumps(hello).encode()))
        self.want_write()

    def drop(self) -> None:
        """Let the connection go; what it had not taken yet stays for the next one."""
        if self.link is None:
            return
        for stream in (self.source, self.sink):
            with contextlib.suppress(KeyError):
                self.selector.unregister(stream)
            os.close(stream)
        self.link.close()
        self.link = None
        self.greeted = False
        self.incoming.clear()
        self.outgoing.clear()

    def read(self) -> None:
        """Read frames, and do what they say."""
        try:
            data = os.read(self.source, 1 << 18)
        except BlockingIOError:
            return
        except OSError:
            data = b''
        if not data:
            self.drop()
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
            if kind < CONTROL:
                self.received += 1
                self.unacked += end
            self.take(kind, number, payload)
        if self.unacked >= ACK_EVERY:
            self.acknowledge(ACK)

    def take(self, kind: int, number: int, payload: bytes) -> None:
        """Do what a frame says."""
        process = self.processes.get(number)
        if kind == OPEN:
            self.open(number, json.loads(payload))
        elif kind == PING:
            self.acknowledge(PONG)
        elif kind in (ACK, HELLO):
            count, = struct.unpack('>Q', payload)
            while self.kept and self.sent - len(self.kept) < count:
                self.kept.popleft()
            if kind == HELLO:
                # a new connection: what the last one had not brought over
                self.greeted = True
                self.outgoing.extend(self.kept)
                self.want_write()
        elif kind == GONE:
            self.drop()
            self.heard = -1e9
        elif process is None:
            pass  # it was closed meanwhile
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

    def acknowledge(self, kind: int) -> None:
        """Tell how many counted frames have come."""
        self.unacked = 0
        if self.link is not None:
            self.outgoing.append(frame(kind, 0, struct.pack('>Q', self.received)))
            self.want_write()

    def send(self, kind: int, number: int, payload: bytes = b'') -> None:
        """Send a counted frame, now or over the next connection."""
        data = frame(kind, number, payload)
        self.sent += 1
        self.kept.append(data)
        if self.greeted:
            self.outgoing.append(data)
            self.want_write()

    def want_write(self) -> None:
        """Write as much as the connection takes, and the rest as soon as it takes more."""
        if self.link is None:
            return
        try:
            while self.outgoing:
                data = self.outgoing[0]
                count = os.write(self.sink, data)
                if count < len(data):
                    self.outgoing[0] = data[count:]
                    continue
                self.outgoing.popleft()
        except BlockingIOError:
            with contextlib.suppress(KeyError):
                self.selector.register(self.sink, selectors.EVENT_WRITE, self.want_write)
            return
        except OSError:
            self.drop()
            return
        with contextlib.suppress(KeyError, ValueError):
            self.selector.unregister(self.sink)

    # -- commands -------------------------------------------------------------------------------

    def open(self, number: int, what: dict[str, Any]) -> None:
        """Begin a command."""
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
            self.send(ERR, number)  # has one stream for both
        self.listen(process)

    def listen(self, process: Process) -> None:
        """Read what a command writes."""
        process.paused = False
        for stream in process.streams:
            self.listen_to(stream, functools.partial(self.output, process, stream))

    def output(self, process: Process, stream: int) -> None:
        """Pass on what a command has written."""
        kind = process.streams[stream]
        try:
            data = os.read(stream, CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b''  # a terminal whose last user has gone
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
        """Hand a command its input as it takes it."""
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
            done = True  # it has closed its input; its exit status says why
        if taken:
            self.send(WINDOW, process.number, struct.pack('>I', taken))
        with contextlib.suppress(KeyError):
            self.selector.unregister(stdin)
        if done and not process.terminal:  # whose end of input is a character
            process.stdin = -1
            process.waiting.clear()
            os.close(stdin)

    def reap(self) -> None:
        """Note which commands have exited."""
        with contextlib.suppress(BlockingIOError):
            os.read(self.woken, 4096)
        for process in (*self.processes.values(), *self.ending):
            if not process.exited and process.child.poll() is not None:
                process.exited = True
                if process.number in self.processes:
                    code = process.child.returncode
                    # of a signal, as a shell has it
                    self.send(EXIT, process.number,
                              struct.pack('>i', code if code >= 0 else 128 - code))
                    self.finish(process)

    def finish(self, process: Process) -> None:
        """Forget a command that has exited and whose streams have ended."""
        if process.exited and not process.streams:
            self.close(process)

    def close(self, process: Process) -> None:
        """Let a command go; end it if it runs."""
        del self.processes[process.number]
        for stream in (*process.streams, *([process.stdin] if process.stdin >= 0 else [])):
            with contextlib.suppress(KeyError):
                self.selector.unregister(stream)
            os.close(stream)
        process.streams = {}
        process.stdin = -1
        # what it left in the background on purpose has a group of its own
        if not process.exited:
            process.signal(signal.SIGTERM)
            process.killed_at = time.monotonic()
            self.ending.append(process)


def frame(kind: int, number: int, payload: bytes) -> bytes:
    """Return a frame's bytes."""
    return HEADER.pack(kind, number, len(payload)) + payload


def begin(number: int, what: dict[str, Any]) -> Process:
    """Start a command and return it."""
    user = pwd.getpwnam('root' if what['root'] else what['user'])
    environment = {
        **os.environ, 'HOME': user.pw_dir, 'USER': user.pw_name, 'LOGNAME': user.pw_name,
        'SHELL': user.pw_shell or '/bin/sh', **what['env']}
    if user.pw_uid != 0:
        # tells that root's rights are to be had without sudo
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


def main(session: str, resume: bool) -> None:
    """Hand this process's streams to the session's daemon, and stay as long as it has them."""
    name = '\0fogros2-shell-' + session
    link = socket.socket(socket.AF_UNIX)
    try:
        link.connect(name)
    except ConnectionRefusedError:
        if resume:
            os.write(1, frame(GONE, 0, b''))
            return
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(name)
        listener.listen(4)
        if os.fork() == 0:
            daemon(listener)
        listener.close()
        link.connect(name)
    socket.send_fds(link, [b'x'], [0, 1])
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1):
        os.dup2(nothing, stream)
    with contextlib.suppress(OSError):
        link.recv(1)


def daemon(listener: socket.socket) -> NoReturn:
    """Serve, out of reach of what becomes of the ``exec`` that began this."""
    try:
        os.setsid()
        os.chdir('/')
        os.umask(0o022)
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        os.close(nothing)
        Daemon(listener).run()
    finally:
        os._exit(0)


if __name__ == '__main__':
    main(sys.argv[1], sys.argv[2] == 'resume')
