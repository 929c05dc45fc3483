# SPDX-License-Identifier: Apache-2.0
"""One machine, followed: its agent over a connection that is kept, its VPN, its log's end."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
import contextlib
import dataclasses
import threading
import time
from typing import Any, Optional

from fogros2 import shell as shells
from fogros2.agent_client import AgentClient
from fogros2.errors import ConnectError, FogError
from fogros2.model import Command
from fogros2.shell import Shell
from fogros2.store import Record
from ros2fog_cli.api import machines, reach
from ros2fog_cli.api.log import describe
from ros2fog_cli.api.machines import Entry

#: Lines of the log that are kept, and characters of one.
LINES, WIDTH = 500, 2000
#: Seconds from one attempt to connect to the next, growing.
RETRY, LONGEST_RETRY = 2.0, 15.0
#: Seconds from one look at the VPN to the next: where sudo is needed, it logs each of them.
VPN_INTERVAL = 2.0
#: Bytes of a process's command line that are looked at.
_WORDS = 32_768

Changed = Callable[[], None]


@dataclasses.dataclass(frozen=True)
class LogLine:
    """A line of a machine's log; ``number`` counts from 1, ``time`` is since the epoch."""

    number: int
    time: float
    node: str
    error: bool
    text: str


class Follower:
    """
    Asks a machine's agent and the VPN each ``interval`` seconds, in a thread of its own.

    What it knows is to be read at any time; ``changed`` is called after each change.

    :param entry: the machine; :meth:`know` brings newer ones.
    """

    def __init__(self, entry: Entry, changed: Changed, interval: float = 1.0) -> None:
        assert entry.record is not None
        self._entry = entry
        self._record: Record = entry.record
        self._changed = changed
        self._interval = interval
        self._lock = threading.Lock()
        self._lines: deque[LogLine] = deque(maxlen=LINES)
        self._number = self._seq = 0
        self._vpn_at = -1e9
        self._pids: tuple[int, ...] = ()
        self.vpn: Optional[dict[str, Any]] = None
        self.agent: Optional[dict[str, Any]] = None
        self.problems: dict[str, str] = {}
        #: Names that the machine's nodes go by in the graph.
        self.names: tuple[str, ...] = ()
        self._stopped, self._watched = threading.Event(), threading.Event()
        self._watched.set()
        self._thread = threading.Thread(
            target=self._run, name=f'fog-follow-{entry.name}', daemon=True)
        self._thread.start()

    def know(self, entry: Entry, *, watched: bool = True) -> None:
        """Take what is known of the machine now, and whether anybody looks."""
        if entry.record is not None:
            self._entry, self._record = entry, entry.record
        if watched:
            self._watched.set()
        else:
            self._watched.clear()

    def stop(self) -> None:
        """End it; the connection closes soon after."""
        self._stopped.set()
        self._watched.set()

    def join(self, timeout: float) -> None:
        """Wait for the connection to close, so many seconds."""
        self._thread.join(timeout)

    @property
    def last(self) -> int:
        """The number of the newest line of the log."""
        return self._number

    def lines(self, after: int) -> list[LogLine]:
        """Return the lines of the log that came after the one of that number."""
        with self._lock:
            return [line for line in self._lines if line.number > after]

    # -- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        pause = RETRY
        while self._watched.wait() and not self._stopped.is_set():
            try:
                with contextlib.ExitStack() as undo:
                    client, shell = self._connect(undo)
                    while self._watched.is_set() and not self._stopped.is_set():
                        self._ask(client, shell)
                        pause = RETRY
                        self._stopped.wait(self._interval)
            except FogError as error:
                self._trouble('agent', str(error))
                self.agent = None
                self._look_at_vpn()
                self._changed()
                self._stopped.wait(pause)
                pause = min(1.5 * pause, LONGEST_RETRY)

    def _connect(self, undo: contextlib.ExitStack) -> tuple[AgentClient, Shell]:
        entry = self._entry
        to = reach.endpoint(entry)
        if machines.load(entry.provider).firewall:
            # nothing is opened for somebody who only looks
            inside = reach.through_vpn(entry, to)
            if inside is None:
                raise ConnectError(f"'{entry.name}' isn't in reach through the VPN")
            to = inside
        shell = shells.connect(to, name=entry.name, timeout=10.0)
        undo.callback(shell.close)
        client = reach.agent(entry, shell)
        undo.callback(client.close)
        reply = client.request('status', timeout=15.0)
        if int(reply['next']) <= self._seq:
            self._seq = 0  # an agent with a new log
        client.subscribe(self._take, since=max(self._seq + 1, int(reply['next']) - LINES))
        return client, shell

    def _ask(self, client: AgentClient, shell: Shell) -> None:
        agent = agent_state(client.request('status', timeout=15.0))
        self.problems.pop('agent', None)
        pids = tuple(sorted(node['pid'] for node in agent['nodes'] if node['pid']))
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
            self._trouble('VPN', str(error))
            return
        self.problems.pop('VPN', None)
        self.vpn = None if link is None else {
            **rates(self.vpn, link, time.monotonic()), **dataclasses.asdict(link)}

    def _trouble(self, part: str, text: str) -> None:
        self.problems[part] = text

    def _take(self, event: dict[str, Any]) -> None:
        self._seq = int(_number(event.get('seq')) or self._seq)
        text = describe(event)
        if text is None:
            return
        node, at = str(event.get('name') or ''), _number(event.get('time')) or time.time()
        with self._lock:
            for line in text.splitlines():
                self._number += 1
                self._lines.append(LogLine(
                    self._number, at, node, event.get('stream') == 'stderr', line[:WIDTH]))
        self._changed()


def agent_state(reply: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return what an agent says of itself and its nodes, held to the types that it should have.

    ``since`` in seconds since the epoch, ``rss`` in bytes, ``heartbeat_age`` in seconds, each None
    where unknown; ``nodes`` with name, state and error as text, pid, returncode and restarts.
    """
    rss, nodes = _number(reply.get('rss_kb')), reply.get('nodes')
    return {
        'since': _number(reply.get('since')), 'rss': None if rss is None else int(1000 * rss),
        'heartbeat_age': _number(reply.get('heartbeat_age')),
        'nodes': [{
            'name': str(node.get('name') or ''), 'state': str(node.get('state') or ''),
            'pid': int(_number(node.get('pid')) or 0),
            'returncode': None if (code := _number(node.get('returncode'))) is None
            else int(code),
            'restarts': int(_number(node.get('restarts')) or 0),
            'error': str(node.get('error') or '')}
            for node in (nodes if isinstance(nodes, list) else []) if isinstance(node, dict)]}


def _number(value: Any) -> Optional[float]:
    """Return a number that is one, None for anything else."""
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) \
        and abs(value) < 1e15  # and so neither infinite nor none at all
    return value if usable else None


def rates(before: Optional[dict[str, Any]], link: reach.Link, now: float) -> dict[str, Any]:
    """
    Return ``at``, and bytes per second ``receiving`` and ``sending`` since the look before.

    They are None at the first look, and where the counters have begun anew.
    """
    if before is None:
        return {'at': now, 'receiving': None, 'sending': None}
    seconds = now - before['at']
    if seconds < 0.5:
        return {key: before[key] for key in ('at', 'receiving', 'sending')}
    found: dict[str, Any] = {'at': now}
    for rate, count in (('receiving', 'received'), ('sending', 'sent')):
        more = getattr(link, count) - before[count]
        found[rate] = more / seconds if more >= 0 else None
    return found


def graph_names(shell: Shell, pids: tuple[int, ...]) -> tuple[str, ...]:
    """
    Return the names by which processes on a machine are known in the graph.

    By their ``__node`` remapping, else a program's own name: what most programs call their node.
    """
    if not pids:
        return ()
    result = shell.run(Command((
        'sh', '-c', 'for p; do echo; head -c "$0" "/proc/$p/cmdline" 2>/dev/null | '
        r"tr '\n\0' '\001\n'; done", str(_WORDS), *map(str, pids)),
        what='look at the processes'), timeout=15.0, check=False)
    names = set()
    for words in result.stdout.split('\n\n'):
        name = node_name([word for word in words.split('\n') if word])
        if name:
            names.add(name)
    return tuple(sorted(names))


def node_name(words: list[str]) -> str:
    """Return the name of the node that a command line begins, '' where it says nothing."""
    told = [word.partition('__node:=')[2] for word in words if word.startswith('__node:=')]
    if told:
        return told[0]
    programs = [word for word in words[:3] if word.startswith('/')]
    return programs[-1].rpartition('/')[2].removesuffix('.py') if programs else ''
