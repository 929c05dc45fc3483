# SPDX-License-Identifier: Apache-2.0
"""
Decide when nobody uses a machine: nodes and guests compute nothing, the VPN carries no data.

Runs on the machine as root, as python3 -c SOURCE INTERFACE FOLDER TIMEOUT TOKEN, for each sample
anew. INTERFACE is the VPN's, FOLDER the agent's; a new TOKEN starts the time anew. Prints a reason
and exits with 0 when the machine has been idle for TIMEOUT seconds. Imports nothing of fogros2.

``/run/INTERFACE.watch.json`` is the state, and belongs to root. Times are of the monotonic clock,
which all processes of a machine share.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import json
import os
from pathlib import Path
import pwd
import subprocess
import sys
import time
from typing import Optional

#: Share of a core, and bytes a second in the VPN, that nodes use which wait for something to do:
#: for timers, heartbeats and discovery by the robot.
CPU, TRAFFIC = 0.02, 8192.0
#: Bytes a second that each node adds for each other machine of the launch. Cyclone DDS sends
#: announcements of 620 bytes to ten ports of each machine every 3 s, and gets as many.
DISCOVERY = 4200.0
#: Share of the time that a thread is ready to run from which on it is in use, although it may get
#: less than ``CPU``: others use the processor.
READY = 0.5
#: Homes of the accounts of invited computers, see ``fogros2_features.guests.program``. An account
#: has the name of its interface, 'g' and a number.
GUESTS = Path('/var/lib/fogros2-guests')
#: Linux: the major numbers of terminals of remote logins.
PSEUDO_TERMINALS = range(136, 144)
#: The variable by which the agent marks the nodes' processes, see ``fogros2.agent.processes``.
MARK = 'FOGROS2_AGENT_MARK'


def interval(timeout: float) -> float:
    """Return the seconds between two samples."""
    return min(30.0, max(2.0, timeout / 10))


class Idle:
    """
    Decide when a machine has been idle for ``timeout`` seconds; the caller passes what it used.

    The first sample counts as use: only the next one shows what has changed.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self.since = 0.0
        self.last: Optional[tuple[float, float, float]] = None
        self.threads: dict[str, float] = {}

    def sample(
        self, now: float, cpu: float, traffic: float, threads: dict[str, float], *,
        connected: bool, discovery: float = 0.0,
    ) -> bool:
        """
        Take a sample; return whether the machine has been idle for the whole time-out.

        :param cpu: seconds that the nodes have computed so far. They decrease when processes
            end: then nobody knows what these have computed last, which counts as use.
        :param traffic: bytes that the VPN has carried so far.
        :param threads: by thread, the seconds that it has run or waited for a processor so far.
        :param connected: whether somebody has a terminal there.
        :param discovery: bytes a second that other machines add to TRAFFIC.
        """
        last, self.last = self.last, (now, cpu, traffic)
        before, self.threads = self.threads, threads
        if last is None or connected or not (
                0 <= cpu - last[1] < CPU * (now - last[0])
                and 0 <= traffic - last[2] < (TRAFFIC + discovery) * (now - last[0])
                and all(seconds - before.get(thread, seconds) < READY * (now - last[0])
                        for thread, seconds in threads.items())):
            self.since = now
        return now - self.since >= self.timeout


def _fields(pid: str) -> list[str]:
    """Return the fields of /proc/PID/stat after the name, none if the process has ended."""
    with contextlib.suppress(OSError):
        # the name may contain any bytes
        return Path(f'/proc/{pid}/stat').read_text(errors='replace').rpartition(')')[2].split()
    return []


def _processes() -> list[str]:
    return [name for name in os.listdir('/proc') if name.isdigit()]


def marked(mark: str) -> list[str]:
    """Return the nodes' processes: those with a mark in their environment."""
    pids = []
    for pid in _processes():
        with contextlib.suppress(OSError):
            if f'{MARK}={mark}'.encode() in Path(f'/proc/{pid}/environ').read_bytes().split(b'\0'):
                pids.append(pid)
    return pids


def invited(interface: str) -> list[str]:
    """Return the processes of the computers that were invited to an interface."""
    users, pids = set(), []
    for home in GUESTS.glob(f'{interface}g*'):
        with contextlib.suppress(OSError):  # the computer has left
            users.add(home.stat().st_uid)
    for pid in _processes() if users else ():
        with contextlib.suppress(OSError):
            if os.stat(f'/proc/{pid}').st_uid in users:
                pids.append(pid)
    return pids


def computed(processes: Iterable[str]) -> float:
    """Return the seconds that processes, and their children that have ended, have computed."""
    ticks = sum(int(ticks) for pid in processes for ticks in _fields(pid)[11:15])
    return ticks / os.sysconf('SC_CLK_TCK')


@contextlib.contextmanager
def acting_as(user: int) -> Iterator[None]:
    """Act as a user: root of a container may not see the environment of another's processes."""
    own = os.geteuid(), os.getegid()
    os.setegid(pwd.getpwuid(user).pw_gid)
    os.seteuid(user)
    try:
        yield
    finally:
        os.seteuid(own[0])
        os.setegid(own[1])


def ready(processes: Iterable[str]) -> dict[str, float]:
    """Return by thread the seconds that it has run, or has waited for a processor, so far."""
    seconds = {}
    for pid in processes:
        with contextlib.suppress(OSError, ValueError):  # it has ended
            for task in os.listdir(f'/proc/{pid}/task'):
                ran, waited, _ = Path(f'/proc/{pid}/task/{task}/schedstat').read_text().split()
                seconds[task] = (int(ran) + int(waited)) / 1e9
    return seconds


def carried(interface: str) -> Optional[float]:
    """Return the bytes that a network interface has sent and received, None without it."""
    for line in Path('/proc/net/dev').read_text().splitlines():
        name, _, counters = line.partition(':')
        if name.strip() == interface:
            received, *_, sent = counters.split()[:9]
            return float(received) + float(sent)
    return None


def machines(interface: str) -> int:
    """Return the number of other machines in the VPN."""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        peers = subprocess.run(['wg', 'show', interface, 'peers'], capture_output=True,
                               text=True, timeout=10, check=True).stdout.split()
        return max(0, len(peers) - 1)  # one is the robot
    return 0


def has_terminal(user: int) -> bool:
    """Return whether a process of a user has a terminal, as of ssh, docker or kubectl."""
    for pid in _processes():
        with contextlib.suppress(OSError):
            if os.stat(f'/proc/{pid}').st_uid == user:
                fields = _fields(pid)
                if fields and int(fields[4]) >> 8 & 0xfff in PSEUDO_TERMINALS:
                    return True
    return False


def main(interface: str, folder: str, timeout: float, token: str, run: str = '/run') -> bool:
    """Take one sample; return whether the machine is idle."""
    path, idle = Path(run, f'{interface}.watch.json'), Idle(timeout)
    with contextlib.suppress(FileNotFoundError):
        before, since, last, old_threads = json.loads(path.read_text())
        if before == token:
            idle.since, idle.last, idle.threads = since, last, old_threads
    user = os.stat(folder).st_uid
    try:
        with acting_as(user):
            nodes = marked(str(json.loads(Path(folder, 'watchdog.json').read_text())[0]))
    except (OSError, ValueError, LookupError, TypeError):
        return False  # the agent is being started again
    users = [*nodes, *invited(interface)]
    cpu, threads, connected = computed(users), ready(users), has_terminal(user)
    traffic = carried(interface)
    if traffic is None:
        return False  # the VPN is being repaired, or the launch has ended
    is_idle = idle.sample(time.monotonic(), cpu, traffic, threads, connected=connected,
                          discovery=DISCOVERY * len(nodes) * machines(interface))
    aside = path.with_suffix('.new')
    aside.write_text(json.dumps([token, idle.since, idle.last, idle.threads]))
    aside.replace(path)
    return is_idle


if __name__ == '__main__':
    _, _interface, _folder, _timeout, _token = sys.argv
    if not main(_interface, _folder, float(_timeout), _token):
        sys.exit(1)
    print(f'nobody has used it for {float(_timeout):g} s')
