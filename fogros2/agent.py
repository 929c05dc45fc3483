#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
The agent on a cloud machine: starts the nodes, keeps their log, ends the machine in time.

It is one file for Python 3.10 or newer that uses only the standard library, so that it runs before
anything is installed. One thread serves a selector and never blocks on a client, node or command.

    agent.py serve --config FILE [--detach]    run the agent
    agent.py connect --directory DIR           relay stdin and stdout to a running agent

An agent that was started as root runs with the login user's effective identity, so that root never
opens a file that the user could have replaced. It becomes root again only for commands that need
it: those of the VPN, of a watch, and the one that ends the machine.

**Protocol**: JSON objects, one per line. Request ``{"id": 1, "command": ..., ...}``, reply
``{"id": 1, "ok": true, ...}`` or ``{"id": 1, "ok": false, "error", "hint", "kind"}``:

``configure``  any key of ``CONFIG``; restarts the lifetime and, with ``heartbeat``, the watchdog.
               With another ``launch`` than before, the former launch's nodes stop first, and
               what was kept for that launch ends. Refused (kind ``busy``) while the former launch
               sets the machine up or sends heartbeats, unless ``force`` names the former launch,
               which the robot knows to be dead.
               With ``again`` it claims nothing: refused (kind ``released``) unless its ``launch``
               still has the machine; the request may have been delayed until after a release.
``keep``       ``what``, ``alive`` argv, ``repair`` and ``down`` lists of argv, ``interval`` (s):
               health check with repair
``watch``      ``what``, ``argv``, run as root every ``interval`` (s, default 5). When it exits
               with 0, the agent sends one event named ``what``, with the output as ``reason``,
               and ends the watch.
``launch``     start the process that will run the nodes, ahead of time
``start``      ``nodes``: list of NodeSpec; nodes with a known id are ignored
``stop``       ``nodes``: ids, or null for all; replies at once, ``exited`` events follow
``signal``     ``node``, ``signal``: 'SIGINT'
``status``     see ``Agent.do_status``; ``ping`` is cheaper and returns nothing
``log``        ``from`` seq, ``follow``: replies ``first`` and ``next`` (seqs that exist), then
               sends the lines of the events; ``lost`` counts events that rotation has deleted
``release``    stop the nodes, take down what was kept, disarm the heartbeat, reply when done;
               with ``exit`` true the agent then exits. Does nothing if another launch has taken
               the machine over from ``launch``.

Events, in ``events.jsonl`` and on connections that follow: ``{"seq", "time", "event", ...}`` with
``started``, ``output``, ``exited``, ``refused``, ``watchdog``, ``vpn_repaired``, ``end_failed``,
``notice`` (see ``watch``), ``ending`` when a signal ends the agent, and ``launch_exited`` when the
nodes' launch process ended unexpectedly, with the end of its log as ``said``.

Heartbeats are UDP datagrams from the robot's VPN address, a JSON object with ``launch``. The agent
sends each back with ``clock`` added: the machine's time in seconds since the epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import fcntl
import json
import os
import pwd
import selectors
import signal
import socket
import stat
import subprocess
import sys
import time

TYPE_CHECKING = False  # importing typing takes a megabyte of memory
if TYPE_CHECKING:
    from typing import Any, Optional

    Json = dict[str, Any]

MAX_LINE = 16 << 20
#: Bytes of one generation of the log; two are kept.
LOG_BYTES = 64 << 20
LAUNCH_LOG_BYTES = 8 << 20
#: Bytes at the end of the launch process's log that are reported when it fails.
LAST_WORDS = 1000
BLOCK = 1 << 18
CLIENTS = 64
#: (seconds, signal): when processes that the launch process left behind get each signal.
SWEEP = ((0.0, signal.SIGINT), (3.0, signal.SIGTERM), (6.0, signal.SIGKILL))
SWEEP_QUICKLY = ((0.0, signal.SIGINT), (0.4, signal.SIGTERM), (0.8, signal.SIGKILL))
#: Time-out of a command in seconds, and seconds between attempts to end the machine.
COMMAND_TIMEOUT = 30.0
RETRY_END = 30.0
#: Events that a watch may send, and maximum bytes of the command's output in them.
WATCHED = ('notice',)
REASON = 2000
MARK = 'FOGROS2_AGENT_MARK'
#: Linux: allow to bind to an address that does not exist yet.
IP_FREEBIND = 15

#: Keys of the configuration: accepted types and default value.
CONFIG: dict[str, tuple[tuple[type, ...], Any]] = {
    'machine': ((str,), ''),
    'launch': ((str,), ''),
    'directory': ((str,), ''),
    'user': ((str,), ''),
    'on_exit': ((str,), 'delete'),
    'lifetime': ((int, float), 8 * 3600.0),
    'robot_timeout': ((int, float), 120.0),
    'boot_timeout': ((int, float), 1800.0),
    'end_command': ((list,), []),
    'heartbeat': ((dict, type(None)), None),
    'environment': ((dict,), {}),
    'setup': ((list,), []),
    'ros_command': ((list,), []),
    'log_bytes': ((int,), LOG_BYTES),
}


#: Settings that a restarted agent takes over from its predecessor.
RESUMED = (
    'launch', 'on_exit', 'lifetime', 'robot_timeout', 'heartbeat', 'environment', 'setup',
    'ros_command')


class Refused(Exception):
    """A request that was refused: message, hint, kind."""

    def __init__(self, message: str, hint: str = '', kind: str = '') -> None:
        super().__init__(message)
        self.hint = hint
        self.kind = kind


def boot_clock() -> float:
    """Return seconds since boot, including suspended time."""
    return time.clock_gettime(getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC))


def dump(data: Json) -> bytes:
    """Return one line of JSON."""
    return json.dumps(data, separators=(',', ':')).encode() + b'\n'


def say(text: str) -> None:
    """Write a line to the agent's own log (standard error)."""
    with contextlib.suppress(OSError):
        sys.stderr.write(f'{time.strftime("%Y-%m-%dT%H:%M:%S")} {text}\n')
        sys.stderr.flush()


def checked(new: Json) -> Json:
    """
    Check the types and values of a configuration; drop unknown keys.

    :raises Refused: a value has the wrong type or is invalid.
    """
    known: Json = {}
    for key, value in new.items():
        if key not in CONFIG:
            continue
        types, _ = CONFIG[key]
        if not isinstance(value, types) or isinstance(value, bool):
            raise Refused(f"'{key}' can't be {json.dumps(value)[:80]}")
        if isinstance(value, (int, float)) and not 0 < value < 1e10:
            raise Refused(f"'{key}' has to be above 0, not {value}")
        if isinstance(value, list) and not all(isinstance(word, str) for word in value):
            raise Refused(f"'{key}' has to be a list of words")
        known[key] = value
    if known.get('on_exit', 'delete') not in ('delete', 'stop', 'keep'):
        raise Refused(f"'on_exit' can't be '{known['on_exit']}'", 'delete, stop or keep')
    for key, value in known.get('environment', {}).items():
        if not isinstance(value, str) or '=' in key or '\0' in key + value or not key:
            raise Refused(f"'environment' can't set {key!r}")
    heartbeat = known.get('heartbeat')
    if heartbeat:
        try:
            socket.inet_aton(heartbeat['bind'])
            socket.inet_aton(heartbeat['peer'])
            if not 0 < heartbeat['port'] < 65536:
                raise ValueError('port')
        except (KeyError, OSError, TypeError, ValueError) as error:
            raise Refused("'heartbeat' needs bind and peer, addresses, and a port") from error
    return known


class Watchdog:
    """
    Decide when a machine has to release its nodes; the caller passes the time in seconds.

    ``boot_timeout`` applies until a heartbeat is configured, then ``robot_timeout``.
    """

    def __init__(self, config: Json, now: float) -> None:
        self.config = config
        self.lifetime_from = now
        self.boot_from: Optional[float] = now
        self.beat_at: Optional[float] = None

    def configured(self, now: float, *, heartbeat: bool) -> None:
        """Restart the lifetime and the heartbeat's deadline: a launch has configured the agent."""
        self.lifetime_from = now
        if heartbeat:
            self.boot_from, self.beat_at = None, now
        elif self.boot_from is not None:
            self.boot_from = now

    def beat(self, now: float) -> None:
        """Note a heartbeat; ignored after ``disarm``."""
        if self.beat_at is not None:
            self.beat_at = now

    def disarm(self) -> None:
        """Expect no heartbeat: the launch has ended or is known to be gone; keep the lifetime."""
        self.boot_from = self.beat_at = None

    def deadlines(self) -> list[tuple[float, str]]:
        """Return (time, reason as in the event) of each deadline, soonest first."""
        found = [(self.lifetime_from + self.config['lifetime'], 'lifetime')]
        if self.boot_from is not None:
            found.append((self.boot_from + self.config['boot_timeout'], 'no launch came'))
        if self.beat_at is not None:
            found.append((self.beat_at + self.config['robot_timeout'], 'robot gone'))
        return sorted(found)

    def due(self, now: float) -> Optional[str]:
        """Return the reason of a deadline that has passed, or None."""
        at, reason = self.deadlines()[0]
        return reason if now >= at else None


class LogFile:
    """One generation of the log: whole lines, each beginning ``{"seq":N,``."""

    def __init__(self, path: str, flags: int) -> None:
        self.fd = os.open(
            path, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC | flags, 0o600)
        self.size = os.fstat(self.fd).st_size
        self.first = self.seq_at(0) if self.size else 0

    def __del__(self) -> None:
        with contextlib.suppress(AttributeError, OSError):
            os.close(self.fd)

    def read(self, offset: int, end: Optional[int] = None) -> bytes:
        """Return whole lines from ``offset`` on, at least one if there is one."""
        end = self.size if end is None else min(end, self.size)
        count = BLOCK
        while offset < end:
            data = os.pread(self.fd, min(count, end - offset), offset)
            cut = data.rfind(b'\n') + 1
            if cut:
                return data[:cut]
            if len(data) < count:
                break  # something truncated the file
            count *= 4
        return b''

    def seq_at(self, offset: int) -> int:
        """Return the seq of the line that begins at ``offset``; 0 if it is no line of the log."""
        head = os.pread(self.fd, 40, offset)
        number = head[7:].split(b',')[0]
        return int(number) if head.startswith(b'{"seq":') and number.isdigit() else 0

    def find(self, seq: int) -> int:
        """Return the offset of the first line whose seq is ``seq`` or higher."""
        low, high = 0, self.size  # a line begins at low, at or before the wanted line
        while high - low > 1:
            middle = (low + high) // 2
            line = self.next_line(middle)
            if line < high and self.seq_at(line) < seq:
                low = line
            else:
                high = middle
        while low < self.size and self.seq_at(low) < seq:
            low = self.next_line(low)
        return low

    def next_line(self, offset: int) -> int:
        """Return the offset of the first line after ``offset``, or the file's size."""
        while offset < self.size:
            data = os.pread(self.fd, 4096, offset)
            at = data.find(b'\n')
            if at >= 0:
                return offset + at + 1
            if not data:
                break
            offset += len(data)
        return self.size


class Log:
    """
    The events on disk, in two generations, so that neither memory nor disk fills up.

    :param limit: size of a generation in bytes.
    """

    def __init__(self, directory: str, limit: int) -> None:
        self.path = os.path.join(directory, 'events.jsonl')
        self.old = os.path.join(directory, 'events.1.jsonl')
        self.limit = limit
        self.full = False
        current = LogFile(self.path, os.O_CREAT)
        self._cut_torn_line(current)
        self.files = [current]
        if os.path.exists(self.old):
            self.files.insert(0, LogFile(self.old, 0))
        last = current if current.size else self.files[0]
        self.next = last.seq_at(self._last_line(last)) + 1 if last.size else 1
        if not current.size:
            current.first = self.next

    @staticmethod
    def _last_line(file: LogFile) -> int:
        step = 4096
        while True:
            begin = max(0, file.size - step)
            at = os.pread(file.fd, file.size - begin - 1, begin).rfind(b'\n')
            if at >= 0:
                return begin + at + 1
            if begin == 0:
                return 0
            step *= 8

    def _cut_torn_line(self, file: LogFile) -> None:
        """Remove an incomplete last line that a crash left."""
        if file.size and os.pread(file.fd, 1, file.size - 1) != b'\n':
            file.size = self._last_line(file)
            os.ftruncate(file.fd, file.size)

    @property
    def first(self) -> int:
        """The oldest seq that exists; the next seq if the log is empty."""
        return self.files[0].first

    def append(self, lines: list[bytes]) -> None:
        """Number and write events, given without the first brace: ``"event":...}``."""
        stamp = b'"time":%.6f,' % time.time()
        numbered = []
        for line in lines:
            numbered.append(b'{"seq":%d,' % self.next + stamp + line)
            self.next += 1
        data = b''.join(numbered)
        file = self.files[-1]
        if file.size and file.size + len(data) > self.limit:
            try:
                file = self._rotate(self.next - len(lines))
            except OSError as error:
                say(f"the log can't be rotated: {error}")
        try:
            written = os.write(file.fd, data)
            if written < len(data):
                os.ftruncate(file.fd, file.size)
                raise OSError(28, 'disk full')
            file.size += written
            self.full = False
        except OSError as error:
            # the agent works without a log too; the missing seqs show the gap
            if not self.full:
                say(f'events are being lost: {error}')
            self.full = True

    def _rotate(self, first: int) -> LogFile:
        os.rename(self.path, self.old)
        file = LogFile(self.path, os.O_CREAT | os.O_EXCL)
        file.first = first
        self.files = [self.files[-1], file]
        return file

    def locate(self, seq: int) -> tuple[LogFile, int]:
        """Return the file and the offset at which the events from ``seq`` on begin."""
        chosen = self.files[0]
        for file in self.files[1:]:
            if file.first <= seq:
                chosen = file
        return chosen, chosen.find(seq)


class Client:
    """A connection: receives requests, sends replies and log lines."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.received = bytearray()
        self.out = bytearray()
        self.cursor: Optional[tuple[LogFile, int]] = None
        #: End of a log request without ``follow``.
        self.until: Optional[tuple[LogFile, int]] = None
        self.behind = False
        self.awaiting = 0
        self.finished = False
        self.active = 0.0


class Kept:
    """A health check: a command that checks, and commands that repair."""

    def __init__(self, request: Json) -> None:
        self.what = str(request['what'])
        self.alive = words(request.get('alive', []))
        self.repair = [words(argv) for argv in request.get('repair', [])]
        self.down = [words(argv) for argv in request.get('down', [])]
        self.interval = max(0.05, float(request.get('interval', 1.0)))
        self.repairs = 0
        self.failures = 0
        self.ok = True
        self.since = 0.0
        self.timer: Optional[Timer] = None


class Watched:
    """A command that runs periodically until it succeeds."""

    def __init__(self, request: Json) -> None:
        self.what = str(request['what'])
        self.argv = words(request['argv'])
        self.interval = max(0.05, float(request.get('interval', 5.0)))


def words(argv: Any) -> list[str]:
    """
    Check that a value is a command line; return it.

    :raises Refused: it is not a list of strings.
    """
    if not isinstance(argv, list) or not all(isinstance(w, str) and '\0' not in w for w in argv):
        raise Refused(f'{json.dumps(argv)[:80]} is no list of words')
    return argv


class Timer:
    """A delayed callback; setting ``at`` to None cancels it."""

    def __init__(self, at: float, call: Callable[[], None]) -> None:
        self.at: Optional[float] = at
        self.call = call


class CloudLaunch:
    """
    The process that runs the nodes, and the agent's socket to it.

    :param environment: the configured variables at its start.
    """

    def __init__(self, pid: int, connection: socket.socket, environment: Json) -> None:
        self.pid = pid
        self.environment = dict(environment)
        self.socket = connection
        self.received = bytearray()
        self.out = bytearray()
        self.stopping = False
        self.silent = False


class Agent:
    """
    The agent: clients, the nodes' launch process, health checks and the watchdog in one loop.

    :param config: see ``CONFIG``.
    :param clock: returns monotonic seconds.
    """

    def __init__(self, config: Json, clock: Callable[[], float] = boot_clock) -> None:
        self.clock = clock
        self.config = {key: default for key, (_, default) in CONFIG.items()}
        self.config.update(checked(config))
        self.account = account(self.config['user'])
        self.config['user'] = self.account.pw_name
        self.privileged = os.getuid() == 0
        self.directory = self.config['directory']
        if self.directory.startswith('~/'):
            self.directory = os.path.join(self.account.pw_dir, self.directory[2:])
        self.directory = os.path.normpath(self.directory)
        if not os.path.isabs(self.directory) or self.directory in ('/', self.account.pw_dir):
            # the agent deletes its content in the end, so it must belong to the agent alone
            raise Refused(f"the agent can't have the directory '{self.directory}'")
        self.config['directory'] = self.directory
        self.selector = selectors.DefaultSelector()
        self.timers: list[Timer] = []
        self.children: dict[int, Callable[[int], None]] = {}
        self.clients: list[Client] = []
        self.nodes: dict[str, Json] = {}
        self.kept: dict[str, Kept] = {}
        self.watched: dict[str, Watched] = {}
        self.launch: Optional[CloudLaunch] = None
        self.after_launch: list[Callable[[], None]] = []
        self.stopping = self.ending = self.done = False
        #: Whether a launch has taken the machine over from the launch that created it.
        self.adopted = False
        #: The launch that will have the machine when the former launch's nodes have ended.
        self.claimed = ''
        #: Whether no launch has the machine; late requests of the former launch start nothing.
        self.released = False
        self.heart: Optional[socket.socket] = None
        self.since = time.time()
        self.mark = f'{os.getpid()}-{time.time_ns()}'
        self.watchdog = Watchdog(self.config, clock())

    # -- the directory and the identity -------------------------------------------------------

    @contextlib.contextmanager
    def root(self) -> Iterator[None]:
        """Become root during the block, if the agent was started as root."""
        if not self.privileged:
            yield
            return
        os.seteuid(0)
        os.setegid(0)
        try:
            yield
        finally:
            os.setegid(self.account.pw_gid)
            os.seteuid(self.account.pw_uid)

    def open(self) -> None:
        """
        Create the directory, lock it, and open the socket in it.

        :raises Refused: the directory is not writable, or another agent uses it.
        """
        try:
            if self.privileged:
                os.setegid(self.account.pw_gid)
                os.seteuid(self.account.pw_uid)
            try:
                self._make_directory()
            except PermissionError:
                with self.root():
                    self._make_directory()
            folder = os.stat(self.directory, follow_symlinks=False)
            if not stat.S_ISDIR(folder.st_mode) or folder.st_uid != self.account.pw_uid:
                raise Refused(f'{self.directory} belongs to somebody else')
            os.chmod(self.directory, 0o700)
            self.lock = os.open(
                self.path('agent.pid'),
                os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                other = os.pread(self.lock, 20, 0).decode().strip()
                raise Refused(
                    f'another agent (process {other}) serves {self.directory}',
                    'connect to it', 'running') from None
            self._resume()
            self.log = Log(self.directory, self.config['log_bytes'])
            self.listener = self._listen()
        except OSError as error:
            raise Refused(f"{self.directory} can't be used: {error.strerror or error}") from error

    def _make_directory(self) -> None:
        os.makedirs(os.path.dirname(self.directory), mode=0o755, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.mkdir(self.directory, 0o700)
            # change the owner only of a new directory, and never through a symbolic link
            folder = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            os.fchown(folder, self.account.pw_uid, self.account.pw_gid)
            os.close(folder)

    def _listen(self) -> socket.socket:
        path = self.path('agent.sock')
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)  # left by a former agent: this one holds the lock
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        mask = os.umask(0o177)
        # a Unix socket address has at most 107 bytes; the directory's path may be longer
        folder = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            listener.bind(path if len(path) < 100 else f'/proc/self/fd/{folder}/agent.sock')
        finally:
            os.umask(mask)
            os.close(folder)
        listener.listen(2 * CLIENTS)
        return listener

    def path(self, name: str) -> str:
        """Return the path of a file in the agent's directory."""
        return os.path.join(self.directory, name)

    def _resume(self) -> None:
        """Take over the configuration of an agent that died in this directory."""
        try:
            with open(self.path('config.json')) as stream:
                saved = checked(json.load(stream))
        except (AttributeError, OSError, Refused, ValueError):
            return
        if saved.get('machine') == self.config['machine']:
            # the user could have written the file: take nothing that root would execute
            self.config.update({key: saved[key] for key in RESUMED if key in saved})
            self.watchdog.configured(self.clock(), heartbeat=bool(self.config['heartbeat']))
            if not self.config['launch'] and self.config['on_exit'] == 'keep':
                self.watchdog.disarm()  # a kept machine expects no launch
                self.released = True

    def save(self) -> None:
        """Write the pid for people, and the configuration for a restarted agent."""
        try:
            os.ftruncate(self.lock, 0)
            os.pwrite(self.lock, f'{os.getpid()}\n'.encode(), 0)
            aside = self.path('config.json.new')
            fd = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(fd, 'w') as stream:
                json.dump(self.config, stream)
            os.replace(aside, self.path('config.json'))
        except OSError as error:
            say(f"the configuration can't be kept: {error}")

    # -- the loop -----------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until the agent ends."""
        alarm, wake = socket.socketpair()
        alarm.setblocking(False)
        wake.setblocking(False)
        signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
        # a handler, because children would inherit an ignored SIGHUP
        for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda number, frame: None)
        register = self.selector.register
        register(alarm, selectors.EVENT_READ, lambda mask: self._on_signals(alarm.recv(4096)))
        register(self.listener, selectors.EVENT_READ, lambda mask: self._accept())
        self.save()
        try:
            self.open_heart()
        except Refused as error:
            say(str(error))
        self.every(10.0, self._trim_launch_log)
        if self.log.next > 1:
            # the nodes ended with the agent that died here, and nothing has reported it
            self.emit('launch_exited', returncode=-int(signal.SIGKILL), said='')
        while not self.done:
            now = self.clock()
            if not self.ending:
                self._guard(now)
            soonest = [timer.at for timer in self.timers if timer.at is not None]
            if not self.ending:
                soonest.append(self.watchdog.deadlines()[0][0])
            pause = min(soonest, default=now + 60.0) - now
            for key, mask in self.selector.select(min(60.0, max(0.0, pause))):
                key.data(mask)
            self._run_timers()
        for client in list(self.clients):
            self._drop(client)

    def at(self, delay: float, call: Callable[[], None]) -> Timer:
        """Call a function in ``delay`` seconds."""
        timer = Timer(self.clock() + delay, call)
        self.timers.append(timer)
        return timer

    def every(self, interval: float, call: Callable[[], None]) -> None:
        """Call a function every ``interval`` seconds."""
        def again() -> None:
            call()
            self.at(interval, again)
        self.at(interval, again)

    def _run_timers(self) -> None:
        now = self.clock()
        due = [timer for timer in self.timers if timer.at is not None and timer.at <= now]
        self.timers = [t for t in self.timers if t.at is not None and t.at > now]
        for timer in due:
            if timer.at is not None:
                timer.call()

    def _on_signals(self, numbers: bytes) -> None:
        if signal.SIGCHLD in numbers:
            self._reap()
        if signal.SIGTERM in numbers or signal.SIGINT in numbers:
            if self.ending and self.stopping:
                self.done = True  # the second signal ends the agent at once
            say('asked to end')
            if not self.ending:
                self.emit('ending', reason='asked to end by a signal')
            self.ending = True
            self.at(1.8, self._leave_now)
            self.stop_nodes(lambda: self.take_down(self._leave_now), quickly=True)

    def _leave_now(self) -> None:
        self.done = True
        for name in ('agent.sock', 'agent.pid'):
            with contextlib.suppress(OSError):
                os.unlink(self.path(name))

    def _reap(self) -> None:
        # as process 1 of a container, the agent inherits all orphans
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            call = self.children.pop(pid, None)
            if call is not None:
                call(os.waitstatus_to_exitcode(status))

    def spawn(
        self, argv: list[str], then: Callable[[int], None], *, timeout: float = COMMAND_TIMEOUT,
        output: int = -1,
    ) -> None:
        """
        Run a command, as root if possible; pass its exit status to ``then`` (127: not found).

        Its output goes to the agent's own log, standard output to the descriptor ``output``.
        """
        own_log = sys.stderr.fileno()
        environment = {**os.environ, 'PATH': search_path()}
        try:
            with self.root():
                child = subprocess.Popen(
                    argv, stdin=subprocess.DEVNULL, stdout=own_log if output < 0 else output,
                    stderr=own_log, cwd='/', env=environment, start_new_session=True)
        except (OSError, ValueError) as error:
            say(f'{argv[0] if argv else "an empty command"}: {error}')
            self.at(0.0, lambda: then(127))
            return
        pid = child.pid
        child.returncode = 0  # _reap collects the status

        def expire() -> None:
            say(f'{argv[0]} took longer than {timeout:g} s')
            with self.root(), contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)

        timer = self.at(timeout, expire)

        def exited(status: int) -> None:
            timer.at = None
            then(status)

        self.children[pid] = exited

    def spawn_all(self, commands: list[list[str]], then: Callable[[bool], None]) -> None:
        """Run all commands as root in order; tell ``then`` whether all succeeded."""
        def step(index: int, good: bool) -> None:
            if index == len(commands):
                then(good)
                return
            self.spawn(commands[index], lambda status: step(index + 1, good and status == 0))
        step(0, True)

    # -- events -------------------------------------------------------------------------------

    def emit(self, event: str, **data: Any) -> None:
        """Append an event to the log and send it to the clients that follow."""
        self.write([dump({'event': event, **data})[1:]])

    def write(self, lines: list[bytes]) -> None:
        """Append events, given as in ``Log.append``, and send them to clients that follow."""
        self.log.append(lines)
        for client in list(self.clients):
            if client.cursor is not None and not client.out:
                self._pump(client)

    def _pump(self, client: Client) -> None:
        """Copy log lines to a client until its buffer is full; the log file is the queue."""
        client.behind = False
        while client.cursor is not None:
            if len(client.out) >= BLOCK:
                client.behind = True
                break
            file, offset = client.cursor
            if file not in self.log.files:
                client.cursor = (self.log.files[0], 0)
                continue
            end = client.until[1] if client.until and client.until[0] is file else None
            data = file.read(offset, end)
            client.out += data
            if data:
                client.cursor = (file, offset + len(data))
            elif end is not None or (client.until and client.until[0] not in self.log.files):
                client.cursor = client.until = None
            elif file is not self.log.files[-1]:
                client.cursor = (self.log.files[self.log.files.index(file) + 1], 0)
            else:
                break
        self._flush(client)

    # -- clients ------------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            connection, _ = self.listener.accept()
        except OSError:
            return
        connection.setblocking(False)
        if len(self.clients) >= CLIENTS:
            # connections whose network is gone accumulate here
            self._drop(min(self.clients, key=lambda client: client.active))
        client = Client(connection)
        client.active = self.clock()
        self.clients.append(client)
        self.selector.register(
            connection, selectors.EVENT_READ, lambda mask: self._serve(client, mask))

    def _drop(self, client: Client) -> None:
        if client in self.clients:
            self.clients.remove(client)
            with contextlib.suppress(KeyError):
                self.selector.unregister(client.socket)
            client.socket.close()

    def _serve(self, client: Client, mask: int) -> None:
        if mask & selectors.EVENT_READ:
            try:
                data = client.socket.recv(BLOCK)
            except BlockingIOError:
                data = None
            except OSError:
                self._drop(client)
                return
            if data:
                client.active = self.clock()
                client.received += data
                self._requests(client)
            elif data == b'':
                # answer complete requests, drop an incomplete one
                client.finished = True
                client.cursor = client.cursor if client.until else None
        if client in self.clients:
            if mask & selectors.EVENT_WRITE or client.finished:
                self._pump(client)

    def _requests(self, client: Client) -> None:
        *lines, rest = client.received.split(b'\n')
        client.received = rest
        if len(rest) > MAX_LINE:
            client.received = bytearray()
            client.finished = True
            self.reply(client, None, {'error': f'a request is longer than {MAX_LINE} bytes'})
        for line in lines:
            if client in self.clients and line.strip():
                self._request(client, bytes(line))

    def _request(self, client: Client, line: bytes) -> None:
        number = None
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise Refused('a request is a JSON object')
            number = request.get('id')
            command = request.get('command')
            handler = HANDLERS.get(command) if isinstance(command, str) else None
            if handler is None:
                raise Refused(f'no such command: {json.dumps(command)[:80]}',
                              f"there are: {', '.join(sorted(HANDLERS))}", 'unknown')
            answer = handler(self, client, request)
        except Refused as error:
            answer = {'error': str(error), 'hint': error.hint, 'kind': error.kind}
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            what = f'{error} is missing' if isinstance(error, KeyError) else str(error)
            answer = {'error': f'malformed request: {what[:200]}', 'kind': 'malformed'}
        except OSError as error:
            answer = {'error': f'{error.filename or "the machine"}: {error.strerror or error}'}
        if answer is not None:
            self.reply(client, number, answer)

    def reply(self, client: Client, number: Any, answer: Json) -> None:
        """Send a reply; one with ``error`` in it is a failure."""
        if client in self.clients:
            client.out += dump({'id': number, 'ok': 'error' not in answer, **answer})
            self._pump(client)

    def reply_later(self, client: Client, request: Json) -> Callable[[Json], None]:
        """Return a function that sends the reply when it is available."""
        client.awaiting += 1

        def reply(answer: Json) -> None:
            client.awaiting -= 1
            self.reply(client, request.get('id'), answer)
        return reply

    def _flush(self, client: Client) -> None:
        try:
            while client.out:
                del client.out[:client.socket.send(client.out[:BLOCK])]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        if client.finished and not client.out and not client.awaiting and not client.cursor:
            self._drop(client)
            return
        # a socket at its end of file would wake the selector forever
        wanted = 0 if client.finished else selectors.EVENT_READ
        if client.out or client.behind:
            wanted |= selectors.EVENT_WRITE
        self._select(client.socket, wanted, lambda mask: self._serve(client, mask))

    def _select(self, connection: socket.socket, wanted: int, call: Callable[[int], None]) -> None:
        """Register exactly these events of a socket with the selector."""
        key = self.selector.get_map().get(connection)
        if not wanted:
            if key is not None:
                self.selector.unregister(connection)
        elif key is None:
            self.selector.register(connection, wanted, call)
        elif key.events != wanted:
            self.selector.modify(connection, wanted, call)

    # -- requests -----------------------------------------------------------------------------

    def do_configure(self, client: Client, request: Json) -> Optional[Json]:
        """Change settings; a new launch takes the machine over."""
        new = checked(request)
        for fixed in ('directory', 'user', 'log_bytes'):
            new.pop(fixed, None)
        if self.ending:
            raise Refused('this machine is ending', 'launch again', 'ending')
        taken_over = new.get('launch', self.config['launch']) != self.config['launch']
        if taken_over and request.get('again'):
            raise Refused(f"launch '{new['launch']}' doesn't have this machine any more",
                          kind='released')
        age = self.sign_of_life()
        dead = request.get('force') or None
        owner = self.config['launch']  # '' after a reboot: no owner until a launch comes
        if taken_over and owner and age is not None and dead != owner:
            raise Refused(
                f"this machine belongs to launch '{owner}', whose last sign of life is "
                f'{age:.0f} s old', 'end that launch, or choose another name', 'busy')
        stale = self.launch is not None and any(
            key in new and new[key] != self.config[key] for key in ('setup', 'ros_command'))
        running = any(node['state'] in ('starting', 'running') for node in self.nodes.values())

        def apply() -> Json:
            if taken_over:
                if later and self.claimed != new['launch']:
                    return {'error': 'the machine was released meanwhile', 'kind': 'released'}
                self.claimed = ''
                self.adopted = True
                self.nodes.clear()
                new.setdefault('heartbeat', None)
            self.released = self.released and not new.get('launch')
            self.config.update(new)
            self.watchdog.config = self.config
            if taken_over:
                self.watchdog.disarm()
                self.watchdog.boot_from = self.clock()
            self.watchdog.configured(self.clock(), heartbeat=bool(self.config['heartbeat']))
            self.save()
            try:
                self.open_heart()
            except Refused as error:
                return {'error': str(error), 'hint': error.hint}
            return {'machine': self.config['machine'], 'next': self.log.next}

        left = taken_over and (self.launch is not None or bool(self.kept or self.watched))
        later = self.stopping or left or bool(self.launch and stale and not running)
        if later:
            self.claimed = new['launch'] if taken_over else self.claimed
            reply = self.reply_later(client, request)

            def stopped() -> None:
                if taken_over:
                    # the former launch's VPN uses the port that the new launch needs
                    self.take_down(lambda: reply(apply()))
                else:
                    reply(apply())
            self.stop_nodes(stopped)
            return None
        return apply()

    def check_held(self) -> None:
        """
        Refuse to start anything for a launch that has released the machine: a late request.

        :raises Refused: no launch has the machine.
        """
        if self.released:
            raise Refused('no launch has this machine any more', kind='released')

    def do_keep(self, client: Client, request: Json) -> Json:
        """Start a health check, or replace the one with the same ``what``."""
        self.check_held()
        kept = Kept(request)
        former = self.kept.get(kept.what)
        if former is not None and former.timer is not None:
            former.timer.at = None
        self.kept[kept.what] = kept
        if kept.alive:
            self._look(kept)
        return {}

    def do_watch(self, client: Client, request: Json) -> Json:
        """Start a watch, or replace the one with the same ``what``."""
        self.check_held()
        watched = Watched(request)
        if watched.what not in WATCHED or not watched.argv:
            raise Refused(f"there is no watch for '{watched.what}'", ', '.join(WATCHED))
        self.watched[watched.what] = watched
        self._see(watched)
        return {}

    def do_launch(self, client: Client, request: Json) -> Json:
        """Start the launch process, if it does not run."""
        return {'pid': self.start_launch().pid}

    def do_start(self, client: Client, request: Json) -> Json:
        """Start nodes."""
        specs = request['nodes']
        if not isinstance(specs, list) or not all(
                isinstance(spec, dict) and isinstance(spec.get('id'), str)
                and isinstance(spec.get('name'), str) for spec in specs):
            raise Refused("'nodes' is a list of objects with id and name")
        known = [spec['id'] for spec in specs if spec['id'] in self.nodes]
        specs = [spec for spec in specs if spec['id'] not in self.nodes]
        graces = []
        for spec in specs:
            grace = float(spec.get('sigterm_timeout', 5.0)) + float(
                spec.get('sigkill_timeout', 5.0))
            if not 0 <= grace < 1e6:
                raise Refused(f"node '{spec['id']}' can't be given {grace} s to end")
            graces.append(grace)
        launch = self.start_launch()
        for spec, grace in zip(specs, graces):
            self.nodes[spec['id']] = {
                'id': spec['id'], 'name': spec['name'], 'state': 'starting', 'pid': None,
                'returncode': None, 'restarts': 0, 'grace': grace}
        if specs:
            # only variables that changed since its start: sourced files may have extended others
            late = {key: value for key, value in self.config['environment'].items()
                    if launch.environment.get(key) != value}
            self._tell(launch, {'command': 'start', 'nodes': specs, 'environment': late})
        return {'known': known}

    def do_stop(self, client: Client, request: Json) -> Json:
        """Stop nodes as launch does: SIGINT, then SIGTERM, then SIGKILL."""
        ids = request.get('nodes')
        ids = list(self.nodes) if ids is None else [str(number) for number in ids]
        for number in ids:
            if number not in self.nodes:
                raise Refused(f"there is no node '{number}'", kind='not running')
        if self.launch is not None and not self.launch.stopping:
            self._tell(self.launch, {'command': 'stop', 'nodes': ids})
        return {}

    def do_signal(self, client: Client, request: Json) -> Json:
        """Send a node a signal."""
        name = str(request['signal'])
        node = self.nodes.get(str(request['node']))
        if name not in signal.Signals.__members__:
            raise Refused(f"there is no signal '{name}'")
        if node is None or node['state'] not in ('starting', 'running') or self.launch is None:
            raise Refused(f"node '{request['node']}' isn't running", kind='not running')
        self._tell(self.launch, {'command': 'signal', 'node': node['id'], 'signal': name})
        return {}

    def do_status(self, client: Client, request: Json) -> Json:
        """Return the agent's state; ages and remaining times in seconds, memory in kB."""
        with open('/proc/self/statm') as stream:
            rss = int(stream.read().split()[1]) * os.sysconf('SC_PAGE_SIZE') // 1024
        config = self.config
        return {
            'machine': config['machine'], 'launch': config['launch'], 'pid': os.getpid(),
            'user': config['user'], 'directory': self.directory, 'since': self.since,
            'on_exit': config['on_exit'], 'robot_timeout': config['robot_timeout'],
            'lifetime_left': self.watchdog.lifetime_from + config['lifetime'] - self.clock(),
            'heartbeat_age': self.heartbeat_age(), 'ending': self.ending,
            'launch_running': self.launch is not None and not self.launch.stopping,
            'nodes': [{k: v for k, v in node.items() if k != 'grace'}
                      for node in self.nodes.values()],
            'kept': [{'what': kept.what, 'ok': kept.ok, 'repairs': kept.repairs}
                     for kept in self.kept.values()],
            'rss_kb': rss, 'first': self.log.first, 'next': self.log.next,
        }

    def do_ping(self, client: Client, request: Json) -> Json:
        """Reply, as a sign of life."""
        return {}

    def do_log(self, client: Client, request: Json) -> Optional[Json]:
        """Send the events from a seq on."""
        begin = max(1, int(request.get('from') or 1))
        lost = max(0, self.log.first - begin)
        file = self.log.files[-1]
        self.reply(client, request.get('id'), {
            'first': self.log.first, 'next': self.log.next, 'lost': lost})
        client.cursor = self.log.locate(begin)
        client.until = None if request.get('follow') else (file, file.size)
        self._pump(client)
        return None

    def do_release(self, client: Client, request: Json) -> None:
        """Stop the nodes of a launch and release the machine."""
        asked, has = request.get('launch'), self.claimed or self.config['launch']
        if asked and has and asked != has:
            self.reply(client, request.get('id'), {})
            return
        self.claimed = ''
        self.released = True
        self.config['on_exit'] = checked({
            'on_exit': request.get('on_exit', self.config['on_exit'])})['on_exit']
        self.watchdog.disarm()
        self.config.update(heartbeat=None, launch='')
        self.open_heart()
        self.save()
        reply = self.reply_later(client, request)
        leave = bool(request.get('exit'))
        self.ending = self.ending or leave

        def stopped() -> None:
            if leave:
                reply({})
                self.take_down(self._leave_for_good)
            else:
                # end the health check first: it would recreate the VPN interface
                self.take_down(lambda: reply({}))
        self.stop_nodes(stopped)

    # -- the nodes ----------------------------------------------------------------------------

    def start_launch(self) -> CloudLaunch:
        """
        Return the running launch process; start it if needed.

        :raises Refused: it cannot be started now.
        """
        self.check_held()
        if self.ending or self.stopping:
            raise Refused('the agent is stopping its nodes', kind='ending')
        if self.launch is not None:
            return self.launch
        argv = list(self.config['ros_command'])
        if not argv:
            raise Refused("there is no 'ros_command' to run nodes with", 'configure it first')
        for path in self.config['setup']:
            if not os.path.isfile(path):
                raise Refused(f'{path} to be sourced is not there')
        if self.config['setup']:
            lines = [f'. {quoted(path)}' for path in self.config['setup']]
            lines.append('exec ' + ' '.join(quoted(word) for word in argv))
            argv = ['bash', '-c', '\n'.join(lines)]
        ours, theirs = socket.socketpair()
        log = os.open(
            self.path('launch.log'), os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
            | os.O_CLOEXEC, 0o600)
        home = self.account.pw_dir
        identity: Json = {}
        if self.privileged and self.account.pw_uid != 0:
            groups = os.getgrouplist(self.account.pw_name, self.account.pw_gid)
            identity = {'user': self.account.pw_uid, 'group': self.account.pw_gid,
                        'extra_groups': groups}
        try:
            with self.root():
                child = subprocess.Popen(
                    argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                    cwd=home if os.path.isdir(home) else '/', start_new_session=True,
                    env=self._environment(theirs.fileno()), pass_fds=(theirs.fileno(),),
                    umask=0o022, **identity)
        except (OSError, ValueError) as error:
            ours.close()
            raise Refused(f"{argv[0]} can't be started: {error}") from error
        finally:
            os.close(log)
            theirs.close()
        child.returncode = 0  # _reap collects the status
        ours.setblocking(False)
        launch = CloudLaunch(child.pid, ours, self.config['environment'])
        self.launch = launch
        self.children[child.pid] = lambda status: self._launch_exited(launch, status)
        self._select(ours, selectors.EVENT_READ, lambda mask: self._hear(launch, mask))
        return launch

    def _environment(self, fd: int) -> dict[str, str]:
        """Return the variables of a login of the user, and those that the launch configured."""
        user = self.account
        if self.privileged:
            kept = ('LANG', 'LANGUAGE', 'TZ', 'LC_ALL', 'LC_CTYPE', 'LC_NUMERIC')
            environment = {key: os.environ[key] for key in kept if key in os.environ}
            environment['PATH'] = search_path()
            environment.setdefault('LANG', 'C.UTF-8')
            runtime = f'/run/user/{user.pw_uid}'
            if os.path.isdir(runtime):
                environment['XDG_RUNTIME_DIR'] = runtime
        else:
            environment = dict(os.environ)
        environment.update({
            'HOME': user.pw_dir, 'USER': user.pw_name, 'LOGNAME': user.pw_name,
            'SHELL': user.pw_shell or '/bin/sh',
            # send output when it is written, not when a buffer is full
            'PYTHONUNBUFFERED': '1', 'RCUTILS_LOGGING_BUFFERED_STREAM': '1'})
        environment.pop('OVERRIDE_LAUNCH_PROCESS_OUTPUT', None)
        environment.update(self.config['environment'])
        environment.update({
            'FOGROS2_AGENT_FD': str(fd), 'FOGROS2_AGENT_DIRECTORY': self.directory,
            MARK: self.mark})
        return environment

    def _tell(self, launch: CloudLaunch, message: Json) -> None:
        launch.out += dump(message)
        self._hear(launch, selectors.EVENT_WRITE)

    def _hear(self, launch: CloudLaunch, mask: int) -> None:
        """Exchange lines with the launch process."""
        if mask & selectors.EVENT_WRITE:
            try:
                while launch.out:
                    del launch.out[:launch.socket.send(launch.out[:BLOCK])]
            except BlockingIOError:
                pass
            except OSError:
                launch.out.clear()  # the process died; reported when its status is collected
        if mask & selectors.EVENT_READ:
            self._receive(launch)
        wanted = 0 if launch.silent else selectors.EVENT_READ
        if launch.out:
            wanted |= selectors.EVENT_WRITE
        self._select(launch.socket, wanted, lambda mask: self._hear(launch, mask))

    def _receive(self, launch: CloudLaunch) -> bool:
        """Read lines of the launch process; return whether there may be more."""
        try:
            data = launch.socket.recv(BLOCK)
        except BlockingIOError:
            return False
        except OSError:
            data = b''
        launch.silent = not data
        launch.received += data
        *lines, launch.received = launch.received.split(b'\n')
        self._reported([bytes(line) for line in lines if line])
        return bool(data)

    def _reported(self, lines: list[bytes]) -> None:
        """Handle events of the launch process: ``{"event":...}`` lines."""
        events = []
        for line in lines:
            # most lines are output, which changes no state: skip parsing it
            if not line.startswith(b'{"event":"output"'):
                try:
                    self._node_changed(json.loads(line))
                except (KeyError, TypeError, ValueError):
                    say(f'the launch process said {line[:200]!r}')
                    continue
            events.append(line[1:] + b'\n')
        if events:
            self.write(events)

    def _node_changed(self, event: Json) -> None:
        node = self.nodes[event['node']]
        kind = event['event']
        if kind == 'started':
            node['state'], node['pid'] = 'running', event['pid']
        elif kind == 'exited':
            node['state'] = 'starting' if event['respawns'] else 'exited'
            node['restarts'] += bool(event['respawns'])
            node['pid'], node['returncode'] = None, event['returncode']
        elif kind == 'refused':
            node['state'], node['error'] = 'refused', event['error']

    def stop_nodes(self, then: Callable[[], None], *, quickly: bool = False) -> None:
        """Stop every node and the launch process; then call ``then``."""
        self.after_launch.append(then)
        launch = self.launch
        if self.stopping and not quickly:
            return
        self.stopping = True
        if launch is None:
            self.sweep(lambda number: self._stopped(), quickly=quickly)
            return
        if not launch.stopping:
            launch.stopping = True
            with contextlib.suppress(OSError):
                # at the end of file it stops the nodes as launch does
                launch.socket.shutdown(socket.SHUT_WR)
        alive = [n['grace'] for n in self.nodes.values() if n['state'] in ('starting', 'running')]
        patience = [(0.0, signal.SIGINT), (0.4, signal.SIGTERM), (0.8, signal.SIGKILL)]
        if not quickly:
            patience = [(max(alive, default=2.0) + 3.0, signal.SIGKILL)]
        for delay, number in patience:
            self.at(delay, self._signaller(launch, number))

    def _signaller(self, launch: CloudLaunch, number: int) -> Callable[[], None]:
        def send() -> None:
            if self.launch is launch:
                with self.root(), contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(launch.pid, number)
        return send

    def _launch_exited(self, launch: CloudLaunch, status: int) -> None:
        while self._receive(launch):
            pass  # its last lines
        self._select(launch.socket, 0, lambda mask: None)
        launch.socket.close()
        self.launch = None
        expected = self.stopping
        self.stopping = True  # start nothing until its nodes have ended
        left = [n for n in self.nodes.values() if n['state'] in ('starting', 'running')]

        def swept(number: int) -> None:
            lines = []
            for node in left:
                node.update(state='exited', pid=None, returncode=-number)
                lines.append(dump({'event': 'exited', 'node': node['id'], 'name': node['name'],
                                   'returncode': -number, 'respawns': False})[1:])
            if not expected:
                say(f'the launch process ended with status {status}')
                lines.append(dump({'event': 'launch_exited', 'returncode': status,
                                   'said': self._last_words()})[1:])
            if lines:
                self.write(lines)
            self._remove_files()
            self._stopped()
        self.sweep(swept, quickly=self.ending)

    def _stopped(self) -> None:
        self.stopping = False
        calls, self.after_launch = self.after_launch, []
        for call in calls:
            call()

    def sweep(self, then: Callable[[int], None], *, quickly: bool = False) -> None:
        """End processes that the launch process left; pass the last signal sent to ``then``."""
        begin = self.clock()
        steps = list(SWEEP_QUICKLY if quickly else SWEEP)
        last = signal.SIGKILL

        def look() -> None:
            nonlocal last
            left = marked(self.mark)
            if not left or self.clock() - begin > SWEEP[-1][0] + 2.0:
                then(last)
                return
            while steps and self.clock() - begin >= steps[0][0]:
                last = steps.pop(0)[1]
                for pid in left:
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(pid, last)
            self.at(0.02, look)
        look()

    def _remove_files(self) -> None:
        """Remove the folder of received files that a killed launch process left."""
        with contextlib.suppress(OSError):
            for name in os.listdir(self.directory):
                if name.startswith('files-'):
                    remove_tree(self.path(name))

    def _last_words(self) -> str:
        """Return the end of the launch process's log, which shows why it failed."""
        with contextlib.suppress(OSError), open(self.path('launch.log'), 'rb') as log:
            log.seek(max(0, os.fstat(log.fileno()).st_size - LAST_WORDS))
            lines = log.read().decode(errors='replace').split('\n')
            return '\n'.join(line for line in lines if line.strip()).strip()
        return ''

    def _trim_launch_log(self) -> None:
        with contextlib.suppress(OSError):
            if os.path.getsize(self.path('launch.log')) > LAUNCH_LOG_BYTES:
                os.truncate(self.path('launch.log'), 0)

    # -- health checks, watchdog, end ---------------------------------------------------------

    def _look(self, kept: Kept) -> None:
        """Run a health check, repair on failure, and schedule the next check."""
        def later() -> None:
            pause = min(30.0, kept.interval * 2 ** min(kept.failures, 10))
            kept.timer = self.at(pause, lambda: self._look(kept))

        def looked(status: int) -> None:
            if self.kept.get(kept.what) is not kept or self.ending:
                return
            if status == 0:
                kept.ok, kept.failures = True, 0
                later()
                return
            if kept.ok:
                say(f'{kept.what} is down')
                kept.ok, kept.since = False, self.clock()
            self.spawn_all(kept.repair, repaired)

        def repaired(good: bool) -> None:
            if good:
                kept.repairs += 1
                kept.failures, kept.ok = 0, True
                self.emit('vpn_repaired', what=kept.what, seconds=self.clock() - kept.since)
            else:
                kept.failures += 1
            later()

        self.spawn(kept.alive, looked, timeout=10.0)

    def _see(self, watched: Watched) -> None:
        """Run a watch's command; repeat it until it succeeds or the watch ends."""
        if self.watched.get(watched.what) is not watched or self.ending:
            return
        output = os.memfd_create('watch', os.MFD_CLOEXEC)

        def ran(status: int) -> None:
            said = os.pread(output, REASON, 0).decode(errors='replace').strip()
            os.close(output)
            if self.watched.get(watched.what) is not watched:
                return
            if status == 0:
                del self.watched[watched.what]
                say(f'{watched.what}: {said}')
                self.emit(watched.what, reason=said)
            else:
                self.at(watched.interval, lambda: self._see(watched))

        self.spawn(watched.argv, ran, timeout=10.0, output=output)

    def sign_of_life(self) -> Optional[float]:
        """Return seconds since the current launch was last heard, None without a launch."""
        spoke = self.watchdog.beat_at
        if spoke is None:
            spoke = self.watchdog.boot_from
        return None if spoke is None else self.clock() - spoke

    def heartbeat_age(self) -> Optional[float]:
        """Return seconds since the last heartbeat, None if none is expected."""
        beat = self.watchdog.beat_at
        return None if beat is None else self.clock() - beat

    def open_heart(self) -> None:
        """Listen for heartbeats at the configured address."""
        if self.heart is not None:
            self._select(self.heart, 0, lambda mask: None)
            self.heart.close()
            self.heart = None
        where = self.config['heartbeat']
        if not where:
            return
        heart = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            # the VPN's address may appear later, and disappear for a time
            heart.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)
            heart.bind((where['bind'], where['port']))
        except (OSError, OverflowError) as error:
            heart.close()
            raise Refused(f"no heartbeats at {where['bind']}:{where['port']}: {error}") from error
        self.heart = heart
        self.selector.register(heart, selectors.EVENT_READ, lambda mask: self._beat(heart))

    def _beat(self, heart: socket.socket) -> None:
        try:
            data, peer = heart.recvfrom(2048)
            if peer[0] != self.config['heartbeat']['peer']:
                return
            beat = json.loads(data)
            if beat['launch'] != self.config['launch']:
                return
            self.watchdog.beat(self.clock())
            heart.sendto(dump({**beat, 'clock': time.time()}), peer)
        except (OSError, KeyError, TypeError, ValueError, RecursionError):
            return  # the VPN is down, or the datagram is invalid

    def _guard(self, now: float) -> None:
        reason = self.watchdog.due(now)
        if reason is None:
            return
        # 'no launch came' ends a machine whose first launch died, but not an adopted machine
        gone = reason == 'robot gone' or (reason == 'no launch came' and self.adopted)
        stay = gone and self.config['on_exit'] == 'keep'
        ends = 'end the machine' if self.config['end_command'] else 'leave'
        action = 'stop the nodes' if stay else ends
        say(f'{reason}: {action}')
        self.emit('watchdog', reason=reason, action=action)
        self.watchdog.disarm()
        if stay:
            self.stop_nodes(lambda: None)
        else:
            self.ending = True
            self.stop_nodes(self.end_machine)

    def end_machine(self) -> None:
        """End the machine, retrying until it works; exit where there is no end command."""
        command = self.config['end_command']
        if not command:
            self.take_down(self._leave_for_good)
            return

        def ended(status: int) -> None:
            if status != 0:
                self.emit('end_failed', returncode=status)
            if os.getpid() == 1:
                self.done = True  # the container ends with this process
            self.at(RETRY_END, self.end_machine)
        self.spawn(command, ended, timeout=60.0)

    def take_down(self, then: Callable[[], None]) -> None:
        """Run the ``down`` commands of all health checks, then call ``then``."""
        commands = [argv for kept in self.kept.values() for argv in kept.down]
        self.kept.clear()
        self.watched.clear()
        self.spawn_all(commands, lambda good: then())

    def _leave_for_good(self) -> None:
        self.done = True
        remove_tree(self.directory)
        with self.root(), contextlib.suppress(OSError):
            os.rmdir(self.directory)
        parent = os.path.dirname(self.directory)
        if os.path.basename(parent) == 'fogros2':
            # the last agent removes the folder of all agents
            with self.root(), contextlib.suppress(OSError):
                os.rmdir(parent)


HANDLERS: dict[str, Callable[[Agent, Client, Json], Optional[Json]]] = {
    name[3:]: getattr(Agent, name) for name in vars(Agent) if name.startswith('do_')}


def account(user: str) -> pwd.struct_passwd:
    """
    Return the login user's entry in the user database.

    :raises Refused: no such user, or the agent cannot act as that user.
    """
    try:
        entry = pwd.getpwnam(user) if user else pwd.getpwuid(os.getuid())
    except KeyError as error:
        raise Refused(f"there is no user '{user or os.getuid()}' on this machine") from error
    if os.getuid() not in (0, entry.pw_uid):
        raise Refused(f"only root can run nodes as '{user}'", f"run the agent as '{user}'")
    return entry


def search_path() -> str:
    """Return PATH, extended by the folders of system programs."""
    known = os.environ.get('PATH', os.defpath).split(':')
    more = ('/usr/local/bin', '/usr/bin', '/bin', '/usr/local/sbin', '/usr/sbin', '/sbin')
    return ':'.join(known + [folder for folder in more if folder not in known])


def quoted(word: str) -> str:
    """Quote a word for the shell."""
    return "'" + word.replace("'", "'\"'\"'") + "'"


def marked(mark: str) -> list[int]:
    """Return all descendants of the agent's launch process, found by their environment."""
    wanted = f'{MARK}={mark}'.encode()
    found = []
    for name in os.listdir('/proc'):
        if name.isdigit() and int(name) != os.getpid():
            with contextlib.suppress(OSError):
                with open(f'/proc/{name}/environ', 'rb') as stream:
                    if wanted in stream.read().split(b'\0'):
                        found.append(int(name))
    return found


def remove_tree(path: str) -> None:
    """Remove a folder with its content; skip what cannot be removed."""
    for folder, subfolders, files in os.walk(path, topdown=False):
        for name in files + subfolders:
            entry = os.path.join(folder, name)
            with contextlib.suppress(OSError):
                link = os.path.islink(entry)
                os.rmdir(entry) if name in subfolders and not link else os.unlink(entry)
    with contextlib.suppress(OSError):
        os.rmdir(path)


def detach() -> int:
    """
    Become a daemon; the parent prints a line about the start, and exits.

    Returns the daemon's descriptor for that line.
    """
    reader, writer = os.pipe()
    if os.fork():
        os.close(writer)
        with os.fdopen(reader, 'rb') as stream:
            line = stream.read()
        sys.stdout.buffer.write(line or dump({'error': 'the agent died while starting'}))
        sys.stdout.flush()
        os._exit(0 if b'"ready":true' in line else 1)
    os.close(reader)
    os.setsid()
    if os.fork():
        os._exit(0)
    null = os.open(os.devnull, os.O_RDWR)
    for fd in (0, 1, 2):
        os.dup2(null, fd)
    return writer


def serve(config_path: str, *, daemon: bool) -> int:
    """Run the agent with a configuration file; return the exit status."""
    answer = -1
    try:
        try:
            with open(config_path) as stream:
                config = json.load(stream)
        except (OSError, ValueError) as error:
            raise Refused(f"the configuration {config_path} can't be read: {error}") from error
        if not isinstance(config, dict) or not config.get('directory'):
            raise Refused(f"the configuration {config_path} names no 'directory'")
        if daemon:
            answer = detach()
        agent = Agent(config)
        agent.open()
    except Refused as error:
        line = {'error': str(error), 'hint': error.hint, 'kind': error.kind}
        if answer >= 0:
            os.write(answer, dump(line))
        else:
            say(str(error))
        return 1
    if answer >= 0:
        log = os.open(agent.path('agent.log'),
                      os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW, 0o600)
        os.dup2(log, 2)
        os.close(log)
        os.write(answer, dump({'ready': True, 'socket': agent.path('agent.sock'),
                               'pid': os.getpid()}))
        os.close(answer)
    agent.run()
    return 0


def connect(directory: str) -> int:
    """Relay stdin and stdout to the agent of a directory; return the exit status."""
    directory = os.path.expanduser(directory)
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        link.connect(f'/proc/self/fd/{folder}/agent.sock')
        os.close(folder)
    except OSError as error:
        sys.stdout.buffer.write(dump({
            'error': f'no agent serves {directory}: {error.strerror}', 'kind': 'absent'}))
        return 3
    sources = [0, link.fileno()]
    selector = selectors.DefaultSelector()
    for source in sources:
        with contextlib.suppress(PermissionError):  # standard input is a file or /dev/null
            selector.register(source, selectors.EVENT_READ)
    if 0 not in selector.get_map():
        link.shutdown(socket.SHUT_WR)
    try:
        while True:
            for key, _ in selector.select():
                data = os.read(key.fd, BLOCK)
                if key.fd == 0 and data:
                    link.sendall(data)
                elif key.fd == 0:
                    selector.unregister(0)
                    link.shutdown(socket.SHUT_WR)  # the agent still answers pending requests
                elif data:
                    while data:
                        data = data[os.write(1, data):]
                else:
                    return 0
    except (BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        return 0


def main(arguments: list[str]) -> int:
    """Run a command line; return the exit status."""
    daemon = '--detach' in arguments
    rest = [word for word in arguments if word != '--detach']
    if len(rest) == 3 and rest[:2] == ['serve', '--config']:
        return serve(rest[2], daemon=daemon)
    if len(rest) == 3 and rest[:2] == ['connect', '--directory']:
        return connect(rest[2])
    sys.stderr.write('usage: agent.py serve --config FILE [--detach]\n'
                     '       agent.py connect --directory DIR\n')
    return 2


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
