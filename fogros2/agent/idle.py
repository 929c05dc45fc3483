# SPDX-License-Identifier: Apache-2.0
"""When nobody uses the machine: its nodes compute nothing, and its VPN carries no data."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct

from fogros2.agent.loop import Loop
from fogros2.agent.processes import marked

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Optional

#: Share of a core, and bytes a second in the VPN, that nodes use which wait for something to do:
#: for timers, discovery and heartbeats.
CPU, TRAFFIC = 0.02, 8192.0
#: Samples in one time-out, and limits of the seconds between two.
SAMPLES, SHORTEST, LONGEST = 10, 2.0, 30.0
#: Linux: the request for an interface's address.
SIOCGIFADDR = 0x8915
#: Linux: the major numbers of terminals of remote logins.
PSEUDO_TERMINALS = range(136, 144)


class Idle:
    """
    Decide when a machine has been idle for ``timeout`` seconds; the caller passes what it used.

    The first sample counts as use: only the next one shows what has changed.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._since = 0.0
        self._last: Optional[tuple[float, float, float]] = None

    def sample(self, now: float, cpu: float, traffic: float, *, connected: bool) -> bool:
        """
        Take a sample; return whether the machine has been idle for the whole time-out.

        :param cpu: seconds that the nodes have computed so far. They decrease when processes
            end: then nobody knows what these have computed last, which counts as use.
        :param traffic: bytes that the VPN has carried so far.
        :param connected: whether somebody has a terminal there.
        """
        last, self._last = self._last, (now, cpu, traffic)
        if last is None or connected or not (
                0 <= cpu - last[1] < CPU * (now - last[0])
                and 0 <= traffic - last[2] < TRAFFIC * (now - last[0])):
            self._since = now
        return now - self._since >= self.timeout


class IdleWatch:
    """
    Take samples on the machine, and call ``found`` once when it has been idle.

    :param user: the login user's id.
    """

    def __init__(self, loop: Loop, user: int, found: Callable[[], None]) -> None:
        self.loop = loop
        self.user = user
        self.found = found
        self._current: object = None

    def stop(self) -> None:
        """End the watch."""
        self._current = None

    def start(self, timeout: Optional[float], mark: str, address: str) -> None:
        """
        Watch for ``timeout`` seconds without use, anew; None: never.

        :param mark: of the nodes' processes, see ``processes.marked``.
        :param address: of the machine in the VPN, '' without a VPN.
        """
        self._current = watch = object()
        if timeout is None:
            return
        idle = Idle(timeout)
        pause = min(LONGEST, max(SHORTEST, timeout / SAMPLES))

        def look() -> None:
            if self._current is not watch:
                return
            if idle.sample(self.loop.clock(), computed(marked(mark)), carried(address),
                           connected=has_terminal(self.user)):
                self._current = None
                self.found()
            else:
                self.loop.at(pause, look)
        look()


def _fields(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat after the name, none if the process has ended."""
    with contextlib.suppress(OSError), open(f'/proc/{pid}/stat') as stream:
        return stream.read().rpartition(')')[2].split()
    return []


def computed(processes: list[int]) -> float:
    """Return the seconds that processes, and their children that have ended, have computed."""
    ticks = sum(int(ticks) for pid in processes for ticks in _fields(pid)[11:15])
    return ticks / os.sysconf('SC_CLK_TCK')


def carried(address: str) -> float:
    """Return the bytes that the interface with an IPv4 address has sent and received."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):
                answer = fcntl.ioctl(asking, SIOCGIFADDR, struct.pack('256s', name.encode()))
                if socket.inet_ntoa(answer[20:24]) == address:
                    return _counted(name)
    return 0.0


def _counted(interface: str) -> float:
    with open('/proc/net/dev') as stream:
        for line in stream:
            name, _, counters = line.partition(':')
            if name.strip() == interface:
                received, *_, sent = counters.split()[:9]
                return float(received) + float(sent)
    return 0.0


def has_terminal(user: int) -> bool:
    """Return whether a process of a user has a terminal, as of ssh, docker or kubectl."""
    for name in os.listdir('/proc'):
        with contextlib.suppress(OSError):
            if name.isdigit() and os.stat(f'/proc/{name}').st_uid == user:
                fields = _fields(int(name))
                if fields and int(fields[4]) >> 8 & 0xfff in PSEUDO_TERMINALS:
                    return True
    return False
