# SPDX-License-Identifier: Apache-2.0
"""Follow one machine: the state of its agent over one connection, its VPN, the end of its log."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import contextlib
import dataclasses
import threading
import time
from typing import Any, Optional

from fogros2.agent_client import AgentClient
from fogros2.errors import FogError
from fogros2.events import Event, Status
from fogros2.model import Command
from fogros2.shell import Shell
from fogros2.store import Record
from ros2fog_cli.api import reach
from ros2fog_cli.api.log import Lines
from ros2fog_cli.api.machines import Entry

#: Number of log lines to keep, and longest line in characters.
LINES, WIDTH = 500, 2000
#: Seconds between two polls of an agent, and between two attempts to connect.
INTERVAL, RETRY = 1.0, 5.0
#: Seconds between two looks at the VPN. sudo, where it is needed, logs each look.
VPN_INTERVAL = 2.0
#: Bytes to read of a process's command line.
_WORDS = 32_768

Changed = Callable[[], None]


class Follower:
    """
    Poll a machine's agent and VPN in a thread.

    The results can be read at any time; the thread calls ``changed`` after each change.

    :param entry: the machine; :meth:`know` replaces it.
    """

    def __init__(self, entry: Entry, changed: Changed) -> None:
        assert entry.record is not None
        self._entry = entry
        self._record: Record = entry.record
        self._changed = changed
        self._lock = threading.Lock()
        self._lines: deque[dict[str, Any]] = deque(maxlen=LINES)
        self._number = self._seq = 0
        self._log = Lines()
        self._vpn_at = -1e9
        self._pids: tuple[int, ...] = ()
        self.vpn: Optional[dict[str, Any]] = None
        self.agent: Optional[Status] = None
        self.problems: dict[str, str] = {}
        #: Names of the machine's nodes in the ROS graph.
        self.names: tuple[str, ...] = ()
        self._stopped = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f'fog-follow-{entry.name}', daemon=True)
        self._thread.start()

    def know(self, entry: Entry) -> None:
        """Update the machine's entry."""
        if entry.record is not None:
            self._entry, self._record = entry, entry.record

    def stop(self) -> None:
        """Stop the thread; it closes the connection soon after."""
        self._stopped.set()

    def join(self, timeout: float) -> None:
        """Wait up to ``timeout`` seconds until the connection is closed."""
        self._thread.join(timeout)

    @property
    def last(self) -> int:
        """The number of the newest log line."""
        return self._number

    def lines(self, after: int) -> list[dict[str, Any]]:
        """
        Return the log lines with a number above ``after``, as JSON values.

        ``number`` counts from 1, ``time`` is in seconds since the epoch; ``node`` may be ''.
        """
        with self._lock:
            return [line for line in self._lines if line['number'] > after]

    # -- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                with contextlib.ExitStack() as undo:
                    client, shell = self._connect(undo)
                    while not self._stopped.is_set():
                        self._ask(client, shell)
                        self._stopped.wait(INTERVAL)
            except FogError as error:
                self.problems['agent'] = str(error)
                self.agent = None
                self._look_at_vpn()
                self._changed()
                self._stopped.wait(RETRY)

    def _connect(self, undo: contextlib.ExitStack) -> tuple[AgentClient, Shell]:
        shell = undo.enter_context(reach.session(self._entry, timeout=10.0, opens=False))
        client = reach.agent(self._entry, shell)
        undo.callback(client.close)
        following = client.status(timeout=15.0)['next']
        if following <= self._seq:
            self._seq = 0  # a new agent, which numbers its log from 1 again
        client.subscribe(self._take, since=max(self._seq + 1, following - LINES))
        return client, shell

    def _ask(self, client: AgentClient, shell: Shell) -> None:
        agent = client.status(timeout=15.0)
        self.problems.pop('agent', None)
        pids = tuple(sorted(node['pid'] for node in agent['nodes'] if node['pid'] is not None))
        if pids != self._pids:
            self.names = graph_names(shell, pids)
            self._pids = pids
        self.agent = agent
        self._look_at_vpn()
        self._changed()

    def _look_at_vpn(self) -> None:
        if time.monotonic() - self._vpn_at < VPN_INTERVAL:
            return
        self._vpn_at = time.monotonic()
        try:
            link = reach.link(self._record, pings=1)
        except FogError as error:
            self.problems['VPN'] = str(error)
            return
        self.problems.pop('VPN', None)
        self.vpn = None if link is None else {
            **rates(self.vpn, link, time.monotonic()), **dataclasses.asdict(link)}

    def _take(self, event: Event) -> None:
        seq, at = event.get('seq'), event.get('time')
        self._seq = seq if isinstance(seq, int) else self._seq
        error = event['event'] == 'output' and event['stream'] == 'stderr'
        with self._lock:
            for line in self._log.of(event):
                self._number += 1
                self._lines.append({
                    'number': self._number, 'node': str(event.get('name', '')), 'error': error,
                    'time': at if isinstance(at, (int, float)) else time.time(),
                    'text': line[:WIDTH]})
        self._changed()


def rates(before: Optional[dict[str, Any]], link: reach.Link, now: float) -> dict[str, Any]:
    """
    Return ``at``, and the bytes per second ``receiving`` and ``sending`` since the previous look.

    The rates are None at the first look, and after the counters restarted.
    """
    if before is None:
        return {'at': now, 'receiving': None, 'sending': None}
    seconds = now - before['at']
    if seconds < 0.5:
        return {key: before[key] for key in ('at', 'receiving', 'sending')}
    figures: dict[str, Any] = {'at': now}
    for rate, count in (('receiving', 'received'), ('sending', 'sent')):
        more = getattr(link, count) - before[count]
        figures[rate] = more / seconds if more >= 0 else None
    return figures


def graph_names(shell: Shell, pids: tuple[int, ...]) -> tuple[str, ...]:
    """
    Return the names of processes on a machine in the ROS graph.

    The name is the ``__node`` remapping, else the program's name, which most nodes use.
    """
    if not pids:
        return ()
    result = shell.run(Command((
        'sh', '-c', 'for p; do echo; head -c "$0" "/proc/$p/cmdline" 2>/dev/null | '
        r"tr '\n\0' '\001\n'; done", str(_WORDS), *map(str, pids)),
        what='look at the processes'), timeout=15.0, check=False)
    names = {node_name([word for word in words.split('\n') if word])
             for words in result.stdout.split('\n\n')}
    return tuple(sorted(names - {''}))


def node_name(words: list[str]) -> str:
    """Return the name of the node that a command line starts, '' if unknown."""
    names = [word.partition('__node:=')[2] for word in words if word.startswith('__node:=')]
    if names:
        return names[0]
    programs = [word for word in words[:3] if word.startswith('/')]
    return programs[-1].rpartition('/')[2].removesuffix('.py') if programs else ''
