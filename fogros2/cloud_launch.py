# SPDX-License-Identifier: Apache-2.0
"""
Run inside ``ros2 launch`` on the machine: turn the agent's NodeSpecs into launch's processes.

The file imports only launch and the ament index, not fogros2: it works where only it and
``agent.py`` have been copied. It exchanges JSON lines with the agent over the socket whose number
is in ``FOGROS2_AGENT_FD``. It receives ``start``, ``stop`` and ``signal``, and sends ``NodeEvent``
of ``fogros2.events``. The end of the agent's stream shuts launch down in order.
"""

from __future__ import annotations

import asyncio
import codecs
from collections.abc import Mapping, Sequence
import json
import os
import re
import signal
import socket
import sys
import tempfile
from typing import Any, Optional, TYPE_CHECKING, Union

from ament_index_python.packages import (
    get_package_prefix,
    get_package_share_directory,
    get_packages_with_prefixes,
    PackageNotFoundError,
)
from launch import Action, Event, EventHandler, LaunchContext, LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction
from launch.events import IncludeLaunchDescription, matches_action, Shutdown
from launch.events.process import (
    ProcessExited,
    ProcessIO,
    ProcessStarted,
    ShutdownProcess,
    SignalProcess,
)

if TYPE_CHECKING:
    from fogros2.events import NodeEvent

Json = dict[str, Any]
#: Text with markers, as received: see ``fogros2.model.Text``.
Text = Union[str, Sequence[Union[str, Mapping[str, str]]]]
#: Maximum number of characters in one output event.
CHUNK = 1 << 16
#: Message to a user who starts the launch file by hand.
BY_HAND = (
    'cloud.launch.py is for the agent of a cloud machine, which starts it there to run the nodes '
    "of that machine. To start a machine, launch a file with machine= on a node: 'ros2 launch "
    "fogros2_examples talker.container.launch.py'")


class RefusedNode(Exception):
    """A node that this machine cannot run: message and hint."""

    def __init__(self, message: str, hint: str = '') -> None:
        super().__init__(message)
        self.hint = hint


def generate_launch_description() -> LaunchDescription:
    """Return a launch description that follows the agent's requests until the agent ends."""
    if 'FOGROS2_AGENT_FD' not in os.environ:
        # launch would add lines about syntax to an error that is raised while it loads a file
        return LaunchDescription([OpaqueFunction(function=_refuse_start_by_hand)])
    fd = int(os.environ.pop('FOGROS2_AGENT_FD'))
    directory = os.environ.get('FOGROS2_AGENT_DIRECTORY')
    return LaunchDescription([ObeyAgent(socket.socket(fileno=fd), directory)])


def _refuse_start_by_hand(context: LaunchContext) -> None:
    raise RuntimeError(BY_HAND)


class Node:
    """A NodeSpec and the process that runs it."""

    def __init__(self, spec: Json) -> None:
        self.id: str = spec['id']
        self.name: str = spec['name']
        self.respawn = bool(spec.get('respawn', False))
        self.retries_left = int(spec.get('respawn_max_retries', -1))
        self.process: Optional[ExecuteProcess] = None
        self.running = False
        self.seen = False
        self.stopping = False
        self.expected = True
        self.waiting: list[str] = []  # signals to send when the process has started
        self.held: list[tuple[str, str]] = []  # output that launch reported before ProcessStarted
        decoder = codecs.getincrementaldecoder('utf-8')
        self.decoders = {name: decoder('replace') for name in ('stdout', 'stderr')}


class ObeyAgent(Action):
    """
    Execute requests from the agent's socket and report the results.

    :param connection: the socket, blocking: a slow agent then slows the nodes' output down
        instead of filling this process's memory.
    :param directory: private folder for the contents of sent files; None for the system's folder
        for temporary files.
    """

    def __init__(self, connection: socket.socket, directory: Optional[str] = None) -> None:
        super().__init__()
        connection.setblocking(True)
        connection.set_inheritable(False)
        self._connection = connection
        self._received = b''
        self._nodes: dict[str, Node] = {}
        self._by_action: dict[int, Node] = {}
        self._done: Optional[asyncio.Future[None]] = None
        self._directory = directory
        self._folder: Optional[tempfile.TemporaryDirectory[str]] = None
        self._files = 0

    def execute(self, context: LaunchContext) -> None:
        """Listen to the agent; launch runs until the socket ends."""
        loop = context.asyncio_loop
        self._done = loop.create_future()
        context.register_event_handler(_Watch(self))
        loop.add_reader(self._connection.fileno(), self._read, context)

    def get_asyncio_future(self) -> Optional[asyncio.Future[None]]:
        """Return a future that is done when launch may end."""
        return self._done

    def _read(self, context: LaunchContext) -> None:
        try:
            # MSG_DONTWAIT, because a non-blocking socket would not block for writing either
            data = self._connection.recv(1 << 18, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            data = b''
        if not data:
            context.asyncio_loop.remove_reader(self._connection.fileno())
            for node in self._nodes.values():
                node.stopping = True
            context.emit_event_sync(Shutdown(reason='the agent said so', due_to_sigint=False))
            self.finish()
            return
        *lines, self._received = (self._received + data).split(b'\n')
        for line in lines:
            message = json.loads(line)
            if message['command'] == 'start':
                # an agent of the first version sends variables that were configured later
                os.environ.update(message.get('environment', {}))
                for spec in message['nodes']:
                    self._start(context, spec)
            elif message['command'] == 'stop':
                for node in message['nodes']:
                    self._stop(context, self._nodes.get(node))
            elif message['command'] == 'signal':
                self._signal(context, self._nodes.get(message['node']), message['signal'])

    def finish(self) -> None:
        """Complete the action: launch may end when the nodes have ended."""
        if self._done is not None and not self._done.done():
            self._done.set_result(None)

    def _start(self, context: LaunchContext, spec: Json) -> None:
        node = Node(spec)
        self._nodes[node.id] = node
        try:
            node.process = self._process(spec)
        except RefusedNode as error:
            self._refuse(node, str(error), error.hint)
            return
        except OSError as error:
            self._refuse(node, f'what travelled with {node.name} can not be written there: '
                               f'{error.strerror or error}')
            return
        self._by_action[id(node.process)] = node
        context.emit_event_sync(IncludeLaunchDescription(LaunchDescription([
            node.process, OpaqueFunction(function=self._executed, args=(node,))])))

    def _process(self, spec: Json) -> ExecuteProcess:
        """
        Return the launch action of a NodeSpec.

        :raises RefusedNode: this machine lacks something that the spec names.
        """
        files = {key: self._write(key, text) for key, text in spec.get('files', {}).items()}
        # write contents last: a file may contain the path of another one
        for key, text in spec.get('files', {}).items():
            with open(files[key], 'w', encoding='utf-8') as stream:
                stream.write(resolve(text, files))
        arguments = [resolve(word, files) for word in spec.get('arguments', [])]
        environment: dict[Any, Any] = {  # a dict does not match launch's union type
            name: resolve(value, files) for name, value in spec.get('environment', {}).items()}
        if spec.get('package'):
            arguments.insert(0, find_executable(spec['package'], spec.get('executable', '')))
        words = [*spec.get('prefix', []), *arguments]
        if not words:
            raise RefusedNode('there is nothing to run: no executable and no arguments')
        shell = bool(spec.get('shell', False))
        cwd = spec.get('cwd')
        if cwd is not None and not os.path.isdir(cwd):
            raise RefusedNode(f"the working directory '{cwd}' isn't there")
        if not shell:
            path = environment.get('PATH', os.environ.get('PATH', os.defpath))
            check_program(words[0], path, cwd)
            words = [*spec.get('prefix', []), *interpreter(arguments), *arguments]
        return ExecuteProcess(
            cmd=words,
            name=re.sub(r'-\d+$', '', spec['name']),
            cwd=cwd,
            additional_env=environment,
            shell=shell,
            emulate_tty=bool(spec.get('emulate_tty', False)),
            respawn=bool(spec.get('respawn', False)),
            respawn_delay=float(spec.get('respawn_delay', 0.0)),
            respawn_max_retries=int(spec.get('respawn_max_retries', -1)),
            sigterm_timeout=str(float(spec.get('sigterm_timeout', 5.0))),
            sigkill_timeout=str(float(spec.get('sigkill_timeout', 5.0))),
            output={},  # the agent stores the output: use neither log nor screen
        )

    def _write(self, key: str, text: Text) -> str:
        """Create a private file for ``key``; return its path."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix='files-', dir=self._directory)
        self._files += 1
        name = re.sub(r'[^A-Za-z0-9._-]', '_', os.path.basename(key)) or 'file'
        path = os.path.join(self._folder.name, f'{self._files}-{name[-100:]}')
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        return path

    def _stop(self, context: LaunchContext, node: Optional[Node]) -> None:
        if node is not None and node.process is not None and not node.stopping:
            node.stopping = True
            context.emit_event_sync(ShutdownProcess(process_matcher=matches_action(node.process)))

    def _signal(self, context: LaunchContext, node: Optional[Node], name: str) -> None:
        if node is None or node.process is None:
            return
        if not node.running:
            # launch reports an error for a signal to a process that has not started
            if not node.seen:
                node.waiting.append(name)
            return
        context.emit_event_sync(SignalProcess(
            signal_number=signal.Signals[name], process_matcher=matches_action(node.process)))

    def node_of(self, event: Event) -> Optional[Node]:
        """Return the node of a process event, None for other processes."""
        return self._by_action.get(id(getattr(event, 'action', None)))

    def started(self, context: LaunchContext, node: Node, event: ProcessStarted) -> None:
        """Report the start of a process."""
        node.running = node.seen = True
        node.expected = False
        self._report({'event': 'started', 'node': node.id, 'name': node.name,
                      'pid': event.pid, 'cmd': list(event.cmd)})
        self._let_go(node)
        waiting, node.waiting = node.waiting, []
        for name in waiting:
            self._signal(context, node, name)

    def output(self, node: Node, event: ProcessIO) -> None:
        """Report output of a process."""
        stream = 'stdout' if event.from_stdout else 'stderr'
        text = node.decoders[stream].decode(event.text)
        if node.expected:
            node.held.append((stream, text))
        else:
            self._output(node, stream, text)

    def exited(self, context: LaunchContext, node: Node, event: ProcessExited) -> None:
        """Report the end of a process, and whether launch restarts it."""
        node.running = False
        for stream, decoder in node.decoders.items():
            self._output(node, stream, decoder.decode(b'', final=True))
        respawns = (
            node.respawn and not node.stopping and not context.is_shutdown
            and node.retries_left != 0)
        if respawns and node.retries_left > 0:
            node.retries_left -= 1
        node.expected = respawns
        self._report({'event': 'exited', 'node': node.id, 'name': node.name,
                      'returncode': event.returncode, 'respawns': respawns})

    def _executed(self, context: LaunchContext, node: Node) -> None:
        """Make sure that a process which launch fails to start is reported."""
        future = node.process.get_asyncio_future() if node.process is not None else None
        if future is None:
            self._refuse(node, f'{node.name} came when the machine was shutting down')
            return
        # handled after the ProcessStarted of a process that ended at once
        future.add_done_callback(lambda _: context.emit_event_sync(_Ended(node)))

    def ended(self, node: Node) -> None:
        """Report remaining output, or a failed start, when launch has finished a process."""
        self._let_go(node)
        if not node.seen:
            self._refuse(node, f'{node.name} could not be executed', 'see launch.log there')

    def _let_go(self, node: Node) -> None:
        held, node.held = node.held, []
        for stream, text in held:
            self._output(node, stream, text)

    def _output(self, node: Node, stream: str, text: str) -> None:
        for begin in range(0, len(text), CHUNK):
            self._report({'event': 'output', 'node': node.id, 'name': node.name,
                          'stream': stream, 'text': text[begin:begin + CHUNK]})

    def _refuse(self, node: Node, error: str, hint: str = '') -> None:
        self._report({'event': 'refused', 'node': node.id, 'name': node.name,
                      'error': error, 'hint': hint})

    def _report(self, event: NodeEvent) -> None:
        line = json.dumps(event, separators=(',', ':'))
        try:
            self._connection.sendall(line.encode() + b'\n')
        except OSError:
            pass  # the agent has ended; the end of its stream shuts launch down


class _Ended(Event):
    """launch has finished a process."""

    name = 'fogros2.Ended'

    def __init__(self, node: Node) -> None:
        self.node = node


class _Watch(EventHandler):
    """Handle launch's events about the agent's processes."""

    def __init__(self, obey: ObeyAgent) -> None:
        kinds = (ProcessStarted, ProcessIO, ProcessExited, Shutdown, _Ended)
        super().__init__(matcher=lambda event: isinstance(event, kinds))
        self._obey = obey

    def handle(self, event: Event, context: LaunchContext) -> None:
        super().handle(event, context)
        if isinstance(event, Shutdown):
            self._obey.finish()
            return
        if isinstance(event, _Ended):
            self._obey.ended(event.node)
            return
        node = self._obey.node_of(event)
        if node is None:
            return
        if isinstance(event, ProcessStarted):
            self._obey.started(context, node, event)
        elif isinstance(event, ProcessExited):
            self._obey.exited(context, node, event)
        elif isinstance(event, ProcessIO):
            self._obey.output(node, event)


def resolve(text: Text, files: Mapping[str, str]) -> str:
    """
    Replace the markers in a Text by this machine's paths.

    :param files: path of each received file.
    :raises RefusedNode: a package is not on this machine.
    """
    if isinstance(text, str):
        return text
    parts = []
    for part in text:
        if isinstance(part, str):
            parts.append(part)
        elif 'share' in part:
            prefix_of(part['share'])
            parts.append(get_package_share_directory(part['share']))
        elif 'prefix' in part:
            parts.append(prefix_of(part['prefix']))
        elif part.get('file') in files:
            parts.append(files[part['file']])
        else:
            raise RefusedNode(f'{json.dumps(part)} means nothing to this version of fogros2')
    return ''.join(parts)


def prefix_of(package: str) -> str:
    """
    Return the prefix that a package is installed in.

    :raises RefusedNode: the package is not on this machine.
    """
    try:
        return str(get_package_prefix(package))
    except (PackageNotFoundError, ValueError) as error:
        import difflib
        # the index also lists broken links
        others = [name for name in get_packages_with_prefixes() if name != package]
        near = difflib.get_close_matches(package, others, n=1, cutoff=0.75)
        hint = f"did you mean '{near[0]}'?" if near else 'is its workspace the one that travels?'
        raise RefusedNode(f"package '{package}' not found on the machine", hint) from error


def find_executable(package: str, executable: str) -> str:
    """
    Return the path of a package's executable.

    :raises RefusedNode: the package or the executable is not on this machine.
    """
    folder = os.path.join(prefix_of(package), 'lib', package)
    path = os.path.join(folder, executable)
    if executable and os.path.isfile(path) and os.access(path, os.X_OK):
        return path
    names = sorted(os.listdir(folder)) if os.path.isdir(folder) else []
    hint = f"it has: {', '.join(names[:20])}" if names else 'it has none there'
    raise RefusedNode(
        f"executable '{executable}' not found in package '{package}' on the machine", hint)


def check_program(program: str, path: str, cwd: Optional[str]) -> None:
    """
    Check that a program exists, with the rules of exec.

    :raises RefusedNode: it is missing, or not executable.
    """
    if '/' in program:
        candidates = [os.path.join(cwd or os.getcwd(), program)]
    else:
        candidates = [os.path.join(folder or '.', program) for folder in path.split(':')]
    if any(os.path.isfile(c) and os.access(c, os.X_OK) for c in candidates):
        return
    there = [c for c in candidates if os.path.exists(c)]
    if there:
        raise RefusedNode(f"'{there[0]}' isn't executable on the machine")
    raise RefusedNode(f"'{program}' not found on the machine")


def interpreter(command: Sequence[str]) -> list[str]:
    """
    Return [Python] for a Python program whose interpreter is missing, else [].

    A build in a virtual environment writes that environment's Python into the first line of each
    program. A machine may lack that Python.

    :raises RefusedNode: the first line names a missing interpreter that is not Python.
    """
    try:
        with open(command[0], 'rb') as file:
            line = file.readline(1024)
    except (IndexError, OSError):
        return []
    match = re.match(rb'#!\s*(/\S+)', line)
    if match is None or os.path.exists(match[1]):
        return []
    named = os.fsdecode(match[1])
    if re.fullmatch(r'python[\d.]*', os.path.basename(named)):
        return [sys.executable]
    raise RefusedNode(f"'{command[0]}' is for the interpreter '{named}', "
                      'which is not on the machine', 'install it there')


def main() -> int:
    """Run without ``ros2 launch``; return the exit status."""
    from launch import LaunchService
    service = LaunchService(noninteractive=True)
    service.include_launch_description(generate_launch_description())
    return int(service.run())


if __name__ == '__main__':
    sys.exit(main())
