# SPDX-License-Identifier: Apache-2.0
"""
Warn of images that cross the VPN uncompressed, once each, so that the user can stream them.

The byte counters of the VPN's interface cost nothing to read. Only if they show a busy VPN, a
program of the dashboard inspects the ROS graph for some seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import contextlib
import json
from pathlib import Path
import threading
from typing import Any

from fogros2 import plugin_system, process
from fogros2.errors import FogError
from fogros2.model import Command

#: Poll interval of the counters in seconds; bits per second from which the graph is inspected.
INTERVAL, BUSY = 5.0, 20e6
#: Number of polls that are skipped after an inspection of the graph.
PAUSE = 12
#: Duration of an inspection in seconds, until all nodes are discovered, and its time-out.
INSPECTION, TIMEOUT = 8.0, 40.0
_IMAGE = 'sensor_msgs/msg/Image'


def watch(
    count: Callable[[], int], inspect: Callable[[], Iterable[str]], warn: Callable[[str], None],
    ended: threading.Event, interval: float = INTERVAL,
) -> None:
    """
    Warn once of each image topic that crosses the VPN uncompressed, until the launch ends.

    :param count: returns the bytes that the VPN has carried, both ways; OSError without a VPN.
    :param inspect: returns the image topics that cross the VPN; a FogError ends the watch.
    """
    known: set[str] = set()
    pause = 0
    with contextlib.suppress(OSError, FogError):
        before = count()
        while not ended.wait(interval):
            now = count()
            rate, before = 8 * (now - before) / interval, now
            pause -= 1
            if rate < BUSY or pause > 0:
                continue
            pause = PAUSE
            new = sorted(set(inspect()) - known)
            known.update(new)
            if new:
                verb = 'crosses' if len(new) == 1 else 'cross'
                them = 'it' if len(new) == 1 else 'them'
                warn(f"{', '.join(new)} {verb} the VPN uncompressed at {rate / 1e6:.0f} Mbit/s: "
                     f'add {them} to stream_topics')


def carried(interface: str) -> int:
    """Return the bytes that a network interface has carried, both ways."""
    folder = Path('/sys/class/net', interface, 'statistics')
    return sum(int((folder / f'{way}_bytes').read_text()) for way in ('rx', 'tx'))


def crossing_images(
    machines: Mapping[str, Sequence[str]], environment: Mapping[str, str],
    ended: threading.Event,
) -> list[str]:
    """
    Return the image topics that have publishers and subscribers on different sides of the VPN.

    :param machines: by machine, the names of its nodes.
    :param environment: the variables of the robot's nodes.
    :raises FogError: the launch ends, the program hangs, or it is not installed.
    """
    line = json.dumps({'machines': machines, 'pictures': False}) + '\n'
    # the program prints topics that cross as lines of JSON, until its standard input ends
    program = plugin_system.load('fogros2.monitor', 'graph')
    output = process.run(Command(
        ('sh', '-c', '{ cat; sleep "$0"; } | "$@"', str(INSPECTION), *program),
        input=line.encode(), environment=environment, what='look for images that cross the VPN'),
        timeout=TIMEOUT, check=False, cancel=ended).stdout
    topics: list[str] = []
    for line in output.splitlines():
        topics = images(line) or topics
    return topics


def images(line: str) -> list[str]:
    """Return the image topics in a line of the program's output."""
    try:
        graph: dict[str, Any] = json.loads(line)
        return [one['topic'] for one in graph['topics'] if one['type'] == _IMAGE]
    except (ValueError, KeyError, TypeError):
        return []  # output of a library
