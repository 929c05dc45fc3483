# SPDX-License-Identifier: Apache-2.0
"""The nodes of a machine, and the process of launch that runs them."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import json
import os
import shlex
import signal
import socket
import time

from fogros2.agent.loop import Channel
from fogros2.agent.processes import MARK, Processes, remove_tree, search_path
from fogros2.agent.protocol import dump, Refused, say

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Optional

    from fogros2.agent.protocol import Json
    from fogros2.events import LaunchExited, NodeExited, NodeStatus

LAUNCH_LOG_BYTES = 8 << 20
#: Bytes at the end of the launch process's log that are reported when it fails.
LAST_WORDS = 1000


class CloudLaunch(Channel):
    """The process that runs the nodes, and the agent's socket to it."""

    pid = 0
    stopping = False

    def stop(self) -> None:
        """Make the process stop the nodes as launch does, and end; idempotent."""
        self.stopping = True
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)


class Nodes:
    """
    The nodes of a machine, and the launch process that runs them.

    :param config: the agent's configuration, see ``CONFIG``.
    :param write: appends events to the journal, see ``Journal.append``.
    """

    def __init__(
        self, processes: Processes, directory: str, config: Json,
        write: Callable[[list[bytes]], None],
    ) -> None:
        self.processes = processes
        self.loop = processes.loop
        self.directory = directory
        self.config = config
        self.write = write
        self.mark = f'{os.getpid()}-{time.time_ns()}'
        self.launch: Optional[CloudLaunch] = None
        self.states: dict[str, NodeStatus] = {}
        #: Seconds that each node may take to end.
        self.graces: dict[str, float] = {}
        #: The nodes that start again when they end.
        self.respawn: set[str] = set()
        self.stopping = False
        #: Whether processes that the launch process left get little time to end.
        self.quickly = False
        self.stopped: list[Callable[[], None]] = []

    def path(self, name: str) -> str:
        """Return the path of a file in the agent's directory."""
        return os.path.join(self.directory, name)

    @property
    def running(self) -> list[NodeStatus]:
        """The nodes that run, or are about to."""
        return [n for n in self.states.values() if n['state'] in ('starting', 'running')]

    # -- the launch process ---------------------------------------------------------------------

    def start_launch(self) -> CloudLaunch:
        """
        Return the running launch process; start it if needed.

        :raises Refused: it cannot be started now.
        """
        if self.stopping:
            raise Refused('the agent is stopping its nodes', kind='ending')
        if self.launch is not None:
            return self.launch
        argv, setup = list(self.config['ros_command']), self.config['setup']
        if not argv:
            raise Refused("there is no 'ros_command' to run nodes with", 'configure it first')
        for path in setup:
            if not os.path.isfile(path):
                raise Refused(f'{path} to be sourced is not there')
        if setup:
            lines = [*(f'. {shlex.quote(path)}' for path in setup), f'exec {shlex.join(argv)}']
            argv = ['bash', '-c', '\n'.join(lines)]
        account = self.processes.identity.account
        options: Json = {}
        if os.getuid() != account.pw_uid:
            options = {
                'user': account.pw_uid, 'group': account.pw_gid,
                'extra_groups': os.getgrouplist(account.pw_name, account.pw_gid)}
        ours, theirs = socket.socketpair()
        log = os.open(
            self.path('launch.log'), os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
            | os.O_CLOEXEC, 0o600)
        launch = CloudLaunch(self.loop, ours, self._reported)
        try:
            launch.pid = self.processes.start(
                argv, lambda status: self._launch_exited(launch, status), stdout=log, stderr=log,
                cwd=account.pw_dir if os.path.isdir(account.pw_dir) else '/', umask=0o022,
                env=self._environment(theirs.fileno()), pass_fds=(theirs.fileno(),), **options)
        except (OSError, ValueError) as error:
            launch.close()
            raise Refused(f"{argv[0]} can't be started: {error}") from error
        finally:
            os.close(log)
            theirs.close()
        self.launch = launch
        return launch

    def _environment(self, fd: int) -> dict[str, str]:
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
        environment.pop('OVERRIDE_LAUNCH_PROCESS_OUTPUT', None)
        return {
            **environment, 'HOME': user.pw_dir, 'USER': user.pw_name, 'LOGNAME': user.pw_name,
            'SHELL': user.pw_shell or '/bin/sh',
            # send output when it is written, not when a buffer is full
            'PYTHONUNBUFFERED': '1', 'RCUTILS_LOGGING_BUFFERED_STREAM': '1',
            **self.config['environment'],
            'FOGROS2_AGENT_FD': str(fd), 'FOGROS2_AGENT_DIRECTORY': self.directory,
            MARK: self.mark}

    def trim_log(self) -> None:
        """Empty a large log of the launch process, now and every 10 s."""
        self.loop.at(10.0, self.trim_log)
        with contextlib.suppress(OSError):
            if os.path.getsize(self.path('launch.log')) > LAUNCH_LOG_BYTES:
                os.truncate(self.path('launch.log'), 0)

    def _last_words(self) -> str:
        """Return the end of the launch process's log, which shows why it failed."""
        with contextlib.suppress(OSError), open(self.path('launch.log'), 'rb') as log:
            log.seek(max(0, os.fstat(log.fileno()).st_size - LAST_WORDS))
            lines = log.read().decode(errors='replace').split('\n')
            return '\n'.join(line for line in lines if line.strip()).strip()
        return ''

    # -- requests -------------------------------------------------------------------------------

    def start(self, specs: Any) -> list[str]:
        """
        Start nodes; return the ids of those that were started before.

        :raises Refused: the specs are invalid, or the launch process cannot be started.
        """
        if not isinstance(specs, list) or not all(
                isinstance(spec, dict) and isinstance(spec.get('id'), str)
                and isinstance(spec.get('name'), str) for spec in specs):
            raise Refused("'nodes' is a list of objects with id and name")
        known = [spec['id'] for spec in specs if spec['id'] in self.states]
        specs = [spec for spec in specs if spec['id'] not in self.states]
        graces = {}
        for spec in specs:
            grace = sum(float(spec.get(key, 5.0)) for key in (
                'sigterm_timeout', 'sigkill_timeout'))
            if not 0 <= grace < 1e6:
                raise Refused(f"node '{spec['id']}' can't be given {grace} s to end")
            graces[spec['id']] = grace
        launch = self.start_launch()
        self.graces.update(graces)
        self.respawn.update(spec['id'] for spec in specs if spec.get('respawn'))
        for spec in specs:
            self.states[spec['id']] = {
                'id': spec['id'], 'name': spec['name'], 'state': 'starting', 'pid': None,
                'returncode': None, 'restarts': 0}
        if specs:
            launch.send(dump({'command': 'start', 'nodes': specs}))
        return known

    def stop(self, ids: Any) -> None:
        """
        Stop nodes, all of them if ``ids`` is None, as launch does: SIGINT, SIGTERM, SIGKILL.

        :raises Refused: there is no such node.
        """
        ids = list(self.states) if ids is None else [str(number) for number in ids]
        for number in ids:
            if number not in self.states:
                raise Refused(f"there is no node '{number}'", kind='not running')
        if self.launch is not None and not self.launch.stopping:
            self.launch.send(dump({'command': 'stop', 'nodes': ids}))

    def signal(self, number: str, name: str) -> None:
        """
        Send a node a signal, given by its name.

        :raises Refused: there is no such signal, or the node does not run.
        """
        if name not in signal.Signals.__members__:
            raise Refused(f"there is no signal '{name}'")
        node = self.states.get(number)
        if node is None or node not in self.running or self.launch is None:
            raise Refused(f"node '{number}' isn't running", kind='not running')
        self.launch.send(dump({'command': 'signal', 'node': number, 'signal': name}))

    # -- events of the launch process -----------------------------------------------------------

    def _reported(self, lines: list[bytes]) -> None:
        """Handle events of the launch process: ``{"event":...}`` lines."""
        events = []
        for line in lines:
            # most lines are output, which changes no state: skip parsing it
            if not line.startswith(b'{"event":"output"'):
                try:
                    self._changed(json.loads(line))
                except (KeyError, TypeError, ValueError):
                    say(f'the launch process sent {line[:200]!r}')
                    continue
            events.append(line[1:] + b'\n')
        if events:
            self.write(events)

    def _changed(self, event: Json) -> None:
        node, kind = self.states[event['node']], event['event']
        if kind == 'started':
            node['state'], node['pid'] = 'running', event['pid']
        elif kind == 'exited':
            node['state'] = 'starting' if event['respawns'] else 'exited'
            node['restarts'] += bool(event['respawns'])
            node['pid'], node['returncode'] = None, event['returncode']
        elif kind == 'refused':
            node['state'], node['error'] = 'refused', event['error']

    # -- the end --------------------------------------------------------------------------------

    def stop_all(self, then: Callable[[], None], *, quickly: bool = False) -> None:
        """Stop every node and the launch process; then call ``then``."""
        self.stopped.append(then)
        self.quickly = self.quickly or quickly
        if self.stopping and not quickly:
            return
        self.stopping = True
        launch = self.launch
        if launch is None:
            self.processes.sweep(self.mark, self._swept, quickly=self.quickly)
            return
        launch.stop()
        grace = max((self.graces[node['id']] for node in self.running), default=2.0)
        steps = [(grace + 3.0, signal.SIGKILL)]
        if quickly:
            steps = [(0.0, signal.SIGINT), (0.4, signal.SIGTERM), (0.8, signal.SIGKILL)]
        for delay, number in steps:
            self.loop.at(delay, self._killer(launch, number))

    def _killer(self, launch: CloudLaunch, number: int) -> Callable[[], None]:
        def kill() -> None:
            if self.launch is launch:
                self.processes.kill(launch.pid, number)
        return kill

    def _launch_exited(self, launch: CloudLaunch, status: int) -> None:
        while launch.receive():
            pass  # its last lines
        launch.close()
        self.launch = None
        expected, self.stopping = self.stopping, True  # start nothing until its nodes have ended
        left = self.running

        def swept(number: int) -> None:
            events: list[NodeExited | LaunchExited] = []
            for node in left:
                node['state'], node['pid'], node['returncode'] = 'exited', None, -number
                events.append({'event': 'exited', 'node': node['id'], 'name': node['name'],
                               'returncode': -number,
                               # by the robot, after ``launch_exited``
                               'respawns': not expected and node['id'] in self.respawn})
            if not expected:
                say(f'the launch process ended with status {status}')
                events.append({'event': 'launch_exited', 'returncode': status,
                               'said': self._last_words()})
            if events:
                self.write([dump(event)[1:] for event in events])
            self._swept(number)

        self.processes.sweep(self.mark, swept, quickly=self.quickly)

    def sweep_former(self) -> None:
        """End the nodes of an agent that died here; report that their launch process ended."""
        def swept(number: int) -> None:
            event: LaunchExited = {
                'event': 'launch_exited', 'returncode': -int(signal.SIGKILL), 'said': ''}
            self.write([dump(event)[1:]])
            self._swept(number)

        self.stopping = True
        self.processes.sweep(self.mark, swept, quickly=False)

    def _swept(self, number: int) -> None:
        """Note that no process of the nodes is left, and remove what they received."""
        with contextlib.suppress(OSError):
            for name in os.listdir(self.directory):
                if name.startswith('files-'):
                    remove_tree(self.path(name))
        self.stopping = False
        calls, self.stopped = self.stopped, []
        for call in calls:
            call()
