# SPDX-License-Identifier: Apache-2.0
"""Processes of the agent: as the login user or as root, their end, and periodic commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import os
import pwd
import resource
import signal
import subprocess
import sys

from fogros2.agent.loop import Loop
from fogros2.agent.protocol import Refused, say, words

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from fogros2.agent.protocol import Json
    from fogros2.events import AgentEvent, HealthCheck

#: Time-outs in seconds of commands, and of the commands of watches.
COMMAND_TIMEOUT, CHECK_TIMEOUT = 30.0, 10.0
#: (seconds, signal): when processes that the nodes left behind get each signal.
SWEEP = ((0.0, signal.SIGINT), (3.0, signal.SIGTERM), (6.0, signal.SIGKILL))
SWEEP_QUICKLY = ((0.0, signal.SIGINT), (0.4, signal.SIGTERM), (0.8, signal.SIGKILL))
#: Maximum bytes of a watch's output in its event, and its poll interval in seconds.
REASON, WATCH_INTERVAL = 2000, 5.0
#: The watch for a notice of the provider.
NOTICE = 'notice'
#: The variable that marks the nodes and their descendants.
MARK = 'FOGROS2_AGENT_MARK'


class Identity:
    """
    The login user, as whom the agent acts, and root, where the agent was started as root.

    An agent that was started as root runs with the login user's effective identity, so that root
    never opens a file that the user could have replaced. It becomes root again only for commands
    that need it.

    :raises Refused: no such user, or the agent cannot act as that user.
    """

    def __init__(self, user: str) -> None:
        try:
            self.account = pwd.getpwnam(user) if user else pwd.getpwuid(os.getuid())
        except KeyError as error:
            raise Refused(f"there is no user '{user or os.getuid()}' on this machine") from error
        self.privileged = os.getuid() == 0
        if not self.privileged and os.getuid() != self.account.pw_uid:
            raise Refused(f"only root can run nodes as '{user}'", f"run the agent as '{user}'")

    def assume(self) -> None:
        """Act as the login user."""
        if self.privileged:
            os.setegid(self.account.pw_gid)
            os.seteuid(self.account.pw_uid)

    @property
    def options(self) -> Json:
        """Options of ``Popen`` for a process of the login user, in the user's home."""
        user = self.account
        options: Json = {'cwd': user.pw_dir if os.path.isdir(user.pw_dir) else '/', 'umask': 0o022}
        if os.getuid() != user.pw_uid:
            options.update(user=user.pw_uid, group=user.pw_gid,
                           extra_groups=os.getgrouplist(user.pw_name, user.pw_gid))
        return options

    @contextlib.contextmanager
    def root(self) -> Iterator[None]:
        """Become root during the block, if the agent was started as root."""
        if self.privileged:
            os.seteuid(0)
            os.setegid(0)
        try:
            yield
        finally:
            self.assume()


def search_path() -> str:
    """Return PATH, extended by the folders of system programs."""
    known = os.environ.get('PATH', os.defpath).split(':')
    more = ('/usr/local/bin', '/usr/bin', '/bin', '/usr/local/sbin', '/usr/sbin', '/sbin')
    return ':'.join(known + [folder for folder in more if folder not in known])


def marked(mark: str) -> list[int]:
    """Return the nodes' processes and their descendants, found by their environment."""
    variable = f'{MARK}={mark}'.encode()
    pids: list[int] = []
    try:
        names = os.listdir('/proc')
    except OSError:
        return pids  # no descriptor is left
    for name in names:
        if name.isdigit() and int(name) != os.getpid():
            with contextlib.suppress(OSError), open(f'/proc/{name}/environ', 'rb') as stream:
                if variable in stream.read().split(b'\0'):
                    pids.append(int(name))
    return pids


def remove_tree(path: str) -> None:
    """Remove a folder with its content; skip what cannot be removed."""
    import shutil  # only here, because it takes a megabyte of memory
    shutil.rmtree(path, ignore_errors=True)


class Processes:
    """Start processes in the background, and end them."""

    def __init__(self, loop: Loop, identity: Identity) -> None:
        self.loop = loop
        self.identity = identity
        #: The limits of descriptors that this process was started with.
        self.descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)
        #: Called with the exit status of a child process.
        self.children: dict[int, Callable[[int], None]] = {}

    def reap(self) -> None:
        """Collect the exit status of each child that has ended."""
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

    def start(self, argv: list[str], exited: Callable[[int], None], **options: Any) -> int:
        """
        Start a process as root, if possible, in a session of its own; return its pid.

        :param options: as for ``subprocess.Popen``.
        """
        with self.identity.root():
            child = subprocess.Popen(
                argv, start_new_session=True, **{'stdin': subprocess.DEVNULL, **options})
        child.returncode = 0  # ``reap`` collects the status
        self.children[child.pid] = exited
        return child.pid

    def kill(self, pid: int, number: int) -> None:
        """
        Send a signal to a process that ``start`` returned.

        :param pid: negative for its whole group, which SIGKILL always goes to.
        """
        with self.identity.root(), contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(-abs(pid) if number == signal.SIGKILL else pid, number)

    def spawn(
        self, argv: list[str], then: Callable[[int], None], *, timeout: float = COMMAND_TIMEOUT,
        output: int = -1, **options: Any,
    ) -> None:
        """
        Run a command, as root if possible; pass its exit status to ``then`` (127: not found).

        Its output goes to the agent's own log, standard output to the descriptor ``output``.

        :param options: as for ``subprocess.Popen``.
        """
        def expire() -> None:
            say(f'{argv[0]} took longer than {timeout:g} s')
            self.kill(pid, signal.SIGKILL)

        def exited(status: int) -> None:
            timer.at = None
            then(status)

        own_log = sys.stderr.fileno()
        try:
            pid = self.start(
                argv, exited, stdout=own_log if output < 0 else output, stderr=own_log,
                **{'cwd': '/', 'env': {**os.environ, 'PATH': search_path()}, **options})
        except (OSError, ValueError) as error:
            say(f'{argv[0] if argv else "an empty command"}: {error}')
            self.loop.at(0.0, lambda: then(127))
            return
        timer = self.loop.at(timeout, expire)

    def spawn_all(self, commands: list[list[str]], then: Callable[[bool], None]) -> None:
        """Run all commands as root in order; tell ``then`` whether all succeeded."""
        def step(index: int, good: bool) -> None:
            if index == len(commands):
                then(good)
                return
            self.spawn(commands[index], lambda status: step(index + 1, good and status == 0))
        step(0, True)

    def sweep(self, mark: str, then: Callable[[], None], *, quickly: bool) -> None:
        """End the processes that nodes left behind, then call ``then``."""
        begin = self.loop.clock()
        steps = list(SWEEP_QUICKLY if quickly else SWEEP)

        def look() -> None:
            pids, age = marked(mark), self.loop.clock() - begin
            if not pids or age > SWEEP[-1][0] + 2.0:
                then()
                return
            while steps and age >= steps[0][0]:
                number = steps.pop(0)[1]
                for pid in pids:
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(pid, number)
            self.loop.at(0.02, look)
        look()


class Watch:
    """
    A command that runs periodically.

    :param request: see ``watch`` in the protocol.
    :raises Refused: a value is invalid.
    """

    def __init__(self, request: Json) -> None:
        self.what = request['what']
        self.argv = words(request['argv'])
        if not isinstance(self.what, str) or not self.argv:
            raise Refused(f"'{self.what}' can't be watched")
        repair = request.get('repair')
        #: Commands for each failure; None for a watch that the first success ends.
        self.repair = None if repair is None else [words(argv) for argv in repair]
        self.down = [words(argv) for argv in request.get('down', [])]
        self.interval = max(0.05, float(request.get('interval', WATCH_INTERVAL)))
        self.repairs = 0
        self.failures = 0
        self.ok = True
        self.since = 0.0


class Watches:
    """
    The watches of a launch.

    :param emit: sends an event to the robot.
    """

    def __init__(self, processes: Processes, emit: Callable[[AgentEvent], None]) -> None:
        self.processes = processes
        self.loop = processes.loop
        self.emit = emit
        self.known: dict[str, Watch] = {}
        #: The number of ``take_down`` calls whose commands run, and what follows all of them.
        self.ending = 0
        self._ended: list[Callable[[], None]] = []

    def start(self, watch: Watch) -> None:
        """Start a watch, or replace the one with the same ``what``."""
        self.known[watch.what] = watch
        self._look(watch)

    def _look(self, watch: Watch) -> None:
        if self.known.get(watch.what) is watch:
            try:
                output = os.memfd_create('watch', os.MFD_CLOEXEC)
            except OSError as error:
                say(f'{watch.what}: {error}')
                self._look_later(watch)
                return
            self.processes.spawn(
                watch.argv, lambda status: self._looked(watch, status, output),
                timeout=CHECK_TIMEOUT, output=output)

    def _looked(self, watch: Watch, status: int, output: int) -> None:
        reason = os.pread(output, REASON, 0).decode(errors='replace').strip()
        os.close(output)
        if self.known.get(watch.what) is not watch:
            return
        if watch.repair is not None and status != 0:
            if watch.ok:
                say(f'{watch.what} is down')
                watch.ok, watch.since = False, self.loop.clock()
            self.processes.spawn_all(watch.repair, lambda good: self._repaired(watch, good))
        elif watch.repair is None and status == 0:
            del self.known[watch.what]
            say(f'{watch.what}: {reason}')
            if watch.what == NOTICE:
                self.emit({'event': 'notice', 'reason': reason})
            else:
                self.emit({'event': 'watched', 'what': watch.what, 'reason': reason})
        else:
            watch.ok, watch.failures = True, 0
            self._look_later(watch)

    def _repaired(self, watch: Watch, good: bool) -> None:
        watch.failures = 0 if good else watch.failures + 1
        if good:
            watch.repairs += 1
            watch.ok = True
            self.emit({'event': 'vpn_repaired', 'what': watch.what,
                       'seconds': self.loop.clock() - watch.since})
        self._look_later(watch)

    def _look_later(self, watch: Watch) -> None:
        pause = max(watch.interval, min(30.0, watch.interval * 2 ** min(watch.failures, 10)))
        self.loop.at(pause, lambda: self._look(watch))

    def status(self) -> list[HealthCheck]:
        """Return the state of each watch that repairs."""
        return [{'what': watch.what, 'ok': watch.ok, 'repairs': watch.repairs}
                for watch in self.known.values() if watch.repair is not None]

    def take_down(self, then: Callable[[], None]) -> None:
        """End all watches, run their ``down`` commands, then call ``then``."""
        commands = [argv for watch in self.known.values() for argv in watch.down]
        self.known.clear()
        self.ending += 1
        self._ended.append(then)

        def ended(good: bool) -> None:
            self.ending -= 1
            if not self.ending:
                calls, self._ended = self._ended, []
                for call in calls:
                    call()
        self.processes.spawn_all(commands, ended)
