# SPDX-License-Identifier: Apache-2.0
"""The nodes of a machine, and their processes."""

from __future__ import annotations

import codecs
from collections import deque
from collections.abc import Callable
import contextlib
import functools
import os
import re
import resource
import selectors
import shlex
import signal
import time

from fogros2.agent.loop import Loop, Timer
from fogros2.agent.processes import MARK, Processes, remove_tree, search_path
from fogros2.agent.programs import check_program, find_executable, interpreter, resolve
from fogros2.agent.protocol import Refused

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Optional

    from fogros2.agent.protocol import Json
    from fogros2.events import NodeStatus

#: Maximum number of bytes in one output event, and of such pieces in a pipe.
CHUNK, CHUNKS = 1 << 16, 16
#: Maximum number of bytes of the variables that setup files set.
VARIABLES = 1 << 20
#: The number of nodes that are remembered after they have ended.
ENDED = 300
#: Seconds from one signal to the next where all nodes have to end quickly.
QUICK = (0.4, 0.4)
#: Linux: the option of prctl for the signal that a process gets when its parent dies.
PR_SET_PDEATHSIG = 1


class Output:
    """
    One stream of a process, read as text.

    :param report: called with ``text``.
    """

    def __init__(self, loop: Loop, fd: int, report: Callable[..., None]) -> None:
        os.set_blocking(fd, False)
        self.loop = loop
        self.fd = fd
        self.report = report
        self.decoder = codecs.getincrementaldecoder('utf-8')('replace')
        loop.select(fd, selectors.EVENT_READ, self.read)

    def read(self, mask: int = 0) -> bool:
        """Report text once; return whether there may be more."""
        if self.fd < 0:
            return False
        try:
            data = os.read(self.fd, CHUNK)
        except BlockingIOError:
            return False
        except OSError:
            data = b''  # a terminal that no process has open any more
        text = self.decoder.decode(data, final=not data)
        if text:
            self.report(text=text)
        if not data:
            self.loop.select(self.fd, 0, self.read)
            os.close(self.fd)
            self.fd = -1
        return bool(data)

    def drain(self) -> None:
        """Report what a process has written, but not what its children go on to write."""
        for _ in range(CHUNKS):
            if not self.read():
                return


class Node:
    """
    A NodeSpec, and the process that runs it.

    :raises Refused: the spec is invalid.
    """

    def __init__(self, spec: Json) -> None:
        if not all(isinstance(spec.get(key), str) for key in ('id', 'name')):
            raise Refused("a node has an 'id' and a 'name'")
        self.spec = spec
        self.id: str = spec['id']
        self.retries_left = int(spec.get('respawn_max_retries', -1))
        self.respawn_delay = float(spec.get('respawn_delay', 0.0))
        #: Seconds from SIGINT to SIGTERM, and from there to SIGKILL.
        self.timeouts = (
            float(spec.get('sigterm_timeout', 5.0)), float(spec.get('sigkill_timeout', 5.0)))
        if not all(0 <= seconds < 1e6 for seconds in (*self.timeouts, self.respawn_delay)):
            raise Refused(f"node '{self.id}' can't be given {self.timeouts} s to end")
        self.stopping = False
        #: Command line, and options of ``Popen``; empty until they are known.
        self.command: list[str] = []
        self.options: Json = {}
        #: The folder of its files, '' without files.
        self.folder = ''
        #: Timers of the signals that stop it, or of its next start.
        self.timers: list[Timer] = []
        self.status: NodeStatus = {
            'id': self.id, 'name': spec['name'], 'state': 'starting', 'pid': None,
            'returncode': None, 'restarts': 0}

    def cancel(self) -> None:
        """Cancel its timers."""
        for timer in self.timers:
            timer.at = None
        self.timers.clear()


class Nodes:
    """
    The nodes of a machine.

    :param config: the agent's configuration, see ``CONFIG``.
    :param emit: sends an event to the robot.
    """

    def __init__(
        self, processes: Processes, directory: str, config: Json,
        emit: Callable[[Any], None],
    ) -> None:
        self.processes = processes
        self.loop = processes.loop
        self.directory = directory
        self.config = config
        self.emit = emit
        self.mark = f'{os.getpid()}-{time.time_ns()}'
        #: The nodes that the launch has started, by id, without those that ended long ago.
        self.known: dict[str, Node] = {}
        #: Those that have ended, in this order.
        self.ended: deque[Node] = deque()
        #: Variables of the nodes, and the settings that they were read for.
        self.environment: dict[str, str] = {}
        self.settings: Any = None
        #: The standard input of all nodes: as with launch, it has no data and no end.
        self.stdin, self._no_input = os.pipe()
        self.stopping = False
        #: When to stop waiting for the nodes to end; None unless they are ending.
        self.limit: Optional[Timer] = None
        #: Whether processes that nodes left behind get little time to end.
        self.quickly = False
        self.stopped: list[Callable[[], None]] = []

    # -- the environment ------------------------------------------------------------------------

    def source(self, then: Callable[[Optional[Refused]], None]) -> None:
        """Read the variables that the setup files set, once; then call ``then``."""
        setup, variables = self.config['setup'], self._variables()
        for path in setup:
            if not os.path.isfile(path):
                then(Refused(f'{path} to be sourced is not there'))
                return
        if not setup:
            self.environment = variables
        if not setup or self.settings == (setup, variables):
            then(None)
            return
        try:
            output = os.memfd_create('variables', os.MFD_CLOEXEC)
        except OSError as error:
            then(Refused(f"the setup files can't be sourced: {error}"))
            return

        def ran(status: int) -> None:
            printed = os.pread(output, VARIABLES, 0).decode(errors='surrogateescape')
            os.close(output)
            if status != 0:
                then(Refused(f"{', '.join(setup)} can't be sourced: exit status {status}"))
                return
            pairs = (line.partition('=') for line in printed.split('\0') if line)
            self.environment = {name: value for name, _, value in pairs}
            self.settings = (setup, variables)
            then(None)

        # what the files print is no variable
        lines = ['{', *(f'. {shlex.quote(path)}' for path in setup), '} >&2', 'exec env -0']
        self.processes.spawn(
            ['bash', '-c', '\n'.join(lines)], ran, output=output,
            **{**self.processes.identity.options, 'env': variables})

    def _variables(self) -> dict[str, str]:
        """Return the variables of a login of the user, and those that the launch configured."""
        user = self.processes.identity.account
        environment = dict(os.environ)
        if self.processes.identity.privileged:
            kept = ('LANG', 'LANGUAGE', 'TZ', 'LC_ALL', 'LC_CTYPE', 'LC_NUMERIC')
            environment = {'LANG': 'C.UTF-8', 'PATH': search_path(),
                           **{key: os.environ[key] for key in kept if key in os.environ}}
            runtime = f'/run/user/{user.pw_uid}'
            if os.path.isdir(runtime):
                environment['XDG_RUNTIME_DIR'] = runtime
        return {
            **environment, 'HOME': user.pw_dir, 'USER': user.pw_name, 'LOGNAME': user.pw_name,
            'SHELL': user.pw_shell or '/bin/sh',
            # send output when it is written, not when a buffer is full
            'PYTHONUNBUFFERED': '1', 'RCUTILS_LOGGING_BUFFERED_STREAM': '1',
            **self.config['environment'],
            'FOGROS2_AGENT_DIRECTORY': self.directory, MARK: self.mark}

    # -- requests -------------------------------------------------------------------------------

    def start(self, nodes: list[Node]) -> list[str]:
        """
        Start nodes; return the ids of those that were started before.

        :raises Refused: nodes are being stopped.
        """
        if self.stopping:
            raise Refused('the agent is stopping its nodes', kind='ending')
        known = [node.id for node in nodes if node.id in self.known]
        new = {node.id: node for node in nodes if node.id not in self.known}
        self.known.update(new)
        for node in new.values():
            self._run(node)
        return known

    def clear(self) -> None:
        """Forget all nodes, which have ended: another launch may use their ids."""
        self.known.clear()
        self.ended.clear()

    def stop(self, ids: Any) -> None:
        """
        Stop nodes, all of them if ``ids`` is None, as launch does: SIGINT, SIGTERM, SIGKILL.

        :raises Refused: there is none of these nodes.
        """
        ids = list(self.known) if ids is None else [str(number) for number in ids]
        # the launch may end before it has sent all its nodes
        nodes = [self.known[number] for number in ids if number in self.known]
        if ids and not nodes:
            raise Refused(f"there is no node '{ids[0]}'", kind='not running')
        for node in nodes:
            if not node.stopping:
                self._stop(node, node.timeouts)

    def signal(self, number: str, name: str) -> None:
        """
        Send a node a signal, given by its name.

        :raises Refused: there is no such signal, or the node does not run.
        """
        if name not in signal.Signals.__members__:
            raise Refused(f"there is no signal '{name}'")
        node = self.known.get(number)
        if node is None or node.status['pid'] is None:
            raise Refused(f"node '{number}' isn't running", kind='not running')
        self.processes.kill(node.status['pid'], signal.Signals[name])

    # -- processes ------------------------------------------------------------------------------

    def _report(self, node: Node, event: str, **fields: Any) -> None:
        self.emit({'event': event, 'node': node.id, 'name': node.status['name'], **fields})

    def _run(self, node: Node) -> None:
        """Start a node's process, or report why it cannot start."""
        ours: list[int] = []
        theirs: list[int] = []
        try:
            if not node.command:
                self._prepare(node)
            for _ in ('stdout', 'stderr'):
                reader, writer = os.openpty() if node.spec.get('emulate_tty') else os.pipe()
                ours.append(reader)
                theirs.append(writer)
            pid = self._spawn(node, ours, theirs)
        except (AttributeError, OSError, RecursionError, Refused, TypeError,
                ValueError) as error:
            for fd in ours:
                os.close(fd)
            reason = error if isinstance(error, Refused) else Refused(
                f"{node.status['name']} could not be executed: {error}")
            node.status['state'], node.status['error'] = 'refused', reason.answer['error']
            self._report(node, 'refused', error=reason.answer['error'],
                         hint=reason.answer['hint'])
            self._forget(node)
        else:
            node.status['state'], node.status['pid'] = 'running', pid
            self._report(node, 'started', pid=pid, cmd=node.command)
        finally:
            for fd in theirs:
                os.close(fd)

    def _spawn(self, node: Node, ours: list[int], theirs: list[int]) -> int:
        """Start a node's process; return its pid."""
        import ctypes  # here, because it takes memory of agents without nodes
        prctl = ctypes.CDLL(None).prctl
        outputs: list[Output] = []
        command = node.command

        def prepare() -> None:
            # the nodes must not outlive an agent that nothing starts again
            prctl(PR_SET_PDEATHSIG, signal.SIGINT)
            with contextlib.suppress(OSError, ValueError):
                resource.setrlimit(resource.RLIMIT_NOFILE, self.processes.descriptors)

        if node.spec.get('shell'):
            command = ['/bin/sh', '-c', ' '.join(command)]
        pid = self.processes.start(
            command, lambda status: self._exited(node, outputs, status), stdin=self.stdin,
            stdout=theirs[0], stderr=theirs[1], **node.options, preexec_fn=prepare)
        for stream, fd in zip(('stdout', 'stderr'), ours):
            outputs.append(Output(self.loop, fd, functools.partial(
                self._report, node, 'output', stream=stream)))
        return pid

    def _prepare(self, node: Node) -> None:
        """
        Find out a node's command line and options, and write its files.

        :raises Refused: this machine lacks something that the spec names.
        """
        spec, options = node.spec, self.processes.identity.options
        path = self.environment.get('AMENT_PREFIX_PATH', '')
        files = self._write(node, path)
        environment = {**self.environment, **{
            name: resolve(value, files, path)
            for name, value in spec.get('environment', {}).items()}}
        for name, value in spec.get('folders', {}).items():
            environment[name] = ':'.join(
                filter(None, (resolve(value, files, path), environment.get(name))))
        arguments = [resolve(word, files, path) for word in spec.get('arguments', [])]
        if spec.get('package'):
            arguments.insert(0, find_executable(spec['package'], spec.get('executable', ''), path))
        prefix = [resolve(word, files, path) for word in spec.get('prefix', [])]
        if not prefix + arguments:
            raise Refused('there is nothing to run: no executable and no arguments')
        options['env'], cwd = environment, spec.get('cwd')
        if cwd is not None:
            cwd = resolve(cwd, files, path)
            if not os.path.isdir(cwd):
                raise Refused(f"the working directory '{cwd}' isn't there")
            options['cwd'] = cwd
        if not spec.get('shell'):
            check_program((prefix + arguments)[0], environment.get('PATH', os.defpath),
                          options['cwd'])
            prefix += interpreter(arguments)
        node.command, node.options = prefix + arguments, options

    def _write(self, node: Node, path: str) -> dict[str, str]:
        """
        Write the files that came with a node; return the path of each.

        :raises Refused: a file cannot be written.
        """
        texts: Json = node.spec.get('files', {})
        files = {}
        folder = f'{self.directory}/files-{os.urandom(4).hex()}'
        try:
            if texts:
                os.mkdir(folder, 0o700)
                node.folder = folder
            for number, key in enumerate(texts):
                name = re.sub(r'[^A-Za-z0-9._-]', '_', os.path.basename(key)) or 'file'
                files[key] = f'{folder}/{number}-{name[-100:]}'
            # a file may contain the path of another one
            for key, text in texts.items():
                content = resolve(text, files, path)
                fd = os.open(files[key], os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                with os.fdopen(fd, 'w', encoding='utf-8') as stream:
                    stream.write(content)
        except OSError as error:
            raise Refused(f"what travelled with {node.status['name']} can not be written there: "
                          f'{error.strerror or error}') from error
        return files

    def _exited(self, node: Node, outputs: list[Output], status: int) -> None:
        """Report the end of a node's process, and schedule its next start."""
        for output in outputs:
            output.drain()
        node.cancel()
        respawns = (
            bool(node.spec.get('respawn')) and not node.stopping and node.retries_left != 0)
        node.retries_left -= respawns and node.retries_left > 0
        node.status['state'] = 'starting' if respawns else 'exited'
        node.status['pid'], node.status['returncode'] = None, status
        node.status['restarts'] += respawns
        self._report(node, 'exited', returncode=status, respawns=respawns)
        if respawns:
            node.timers.append(self.loop.at(node.respawn_delay, lambda: self._run(node)))
        else:
            self._forget(node)
        self._check_ended()

    def _forget(self, node: Node) -> None:
        """Free the memory of a node that has ended; forget the one that ended first of many."""
        node.spec, node.command, node.options = {}, [], {}
        self.ended.append(node)
        if len(self.ended) > ENDED:
            first = self.ended.popleft()
            self.known.pop(first.id, None)
            if first.folder:
                remove_tree(first.folder)

    def _stop(self, node: Node, timeouts: tuple[float, float]) -> None:
        """Stop a node's process by SIGINT, and by SIGTERM and SIGKILL after time-outs."""
        node.stopping = True
        node.cancel()
        pid = node.status['pid']
        if pid is None:
            if node.status['state'] == 'starting':
                # it would have respawned
                node.status['state'] = 'exited'
                self._report(node, 'exited', returncode=node.status['returncode'],
                             respawns=False)
                self._forget(node)
            return
        kill = self.processes.kill
        # as Ctrl-C in a terminal: wrappers, such as 'ros2 run', only wait for their children
        kill(pid if node.spec.get('passes_signals') else -pid, signal.SIGINT)
        node.timers += [
            self.loop.at(timeouts[0], lambda: kill(pid, signal.SIGTERM)),
            self.loop.at(sum(timeouts), lambda: kill(pid, signal.SIGKILL))]

    # -- the end --------------------------------------------------------------------------------

    def stop_all(self, then: Callable[[], None], *, quickly: bool = False) -> None:
        """Stop every node and its descendants; then call ``then``."""
        self.stopped.append(then)
        self.quickly = self.quickly or quickly
        if self.stopping and not quickly:
            return
        self.stopping = True
        longest = 0.0
        for node in list(self.known.values()):
            timeouts = QUICK if quickly else node.timeouts
            if node.status['pid'] is not None:
                longest = max(longest, sum(timeouts))
            if quickly or not node.stopping:
                self._stop(node, timeouts)
        if self.limit is not None:
            self.limit.at = None
        # a process in the kernel may not end at all
        self.limit = self.loop.at(longest + 3.0, self._sweep)
        self._check_ended()

    def _check_ended(self) -> None:
        """Go on with the end if no node runs any more."""
        if self.limit is not None and not any(
                node.status['pid'] for node in self.known.values()):
            self._sweep()

    def _sweep(self) -> None:
        """End what nodes left behind."""
        if self.limit is not None:
            self.limit.at = None
            self.limit = None
        self.processes.sweep(self.mark, self._swept, quickly=self.quickly)

    def sweep_former(self) -> None:
        """End the nodes of an agent that died here, and report it."""
        def swept() -> None:
            self.emit({'event': 'restarted'})
            self._swept()

        self.stopping = True
        self.processes.sweep(self.mark, swept, quickly=False)

    def _swept(self) -> None:
        """Note that no process of the nodes is left, and remove what they received."""
        with contextlib.suppress(OSError):
            for name in os.listdir(self.directory):
                if name.startswith('files-'):
                    remove_tree(os.path.join(self.directory, name))
        self.settings = None
        self.stopping = False
        calls, self.stopped = self.stopped, []
        for call in calls:
            call()
