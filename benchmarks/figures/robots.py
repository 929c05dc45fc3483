# SPDX-License-Identifier: Apache-2.0
"""Robots of their own for benchmarks: each has a home, a state folder, an id and a clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import subprocess
import tempfile
from typing import Any

from figures.places import Ec2, Place
from rigs.launched import Launched, ros2
from rigs.traces import RUN

#: What a launch says when its node runs.
UP = 'process started with pid'
DOMAIN = 86
#: Moves the clock of every Python program of a robot.
CLOCK = """\
import os, time
_time, _shift = time.time, float(os.environ['CHAOS_CLOCK'])
time.time = lambda: _time() + _shift
"""


@dataclasses.dataclass(frozen=True)
class Robot:
    """
    A robot with one machine and a home of its own.

    :param clock: seconds by which its clock is ahead.
    """

    place: Place
    name: str
    home: Path
    clock: float = 0.0

    @property
    def state(self) -> Path:
        """Its state folder."""
        return self.home / 'state'

    @property
    def environment(self) -> dict[str, str]:
        """Its variables; none of the user's own settings of clouds."""
        return {
            **os.environ, 'HOME': str(self.home), 'XDG_CONFIG_HOME': str(self.home / 'config'),
            'FOGROS2_STATE_HOME': str(self.state), 'ROS_LOG_DIR': str(self.home / 'log'),
            'ROS_DOMAIN_ID': str(DOMAIN), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'PYTHONPATH': str(self.home),
            'TMPDIR': str(self.home / 'tmp'), 'CHAOS_CLOCK': str(self.clock),
            RUN: f'{os.getpid()}-{self.name}', **self.place.environment}

    def launch(self) -> Launched:
        """Start its launch."""
        path = self.home / 'chaos.launch.py'
        path.write_text(self.place.launch_file(self.name))
        return Launched(str(path), environment=self.environment, prefix=self.place.prefix)

    def gc(self) -> str:
        """Run ``ros2 fog gc`` and return what it printed."""
        done = ros2('fog', 'gc', environment=self.environment, timeout=180.0,
                    prefix=self.place.prefix)
        return f'{done.stdout}{done.stderr}'

    def record(self) -> dict[str, Any]:
        """Return the record of its machine, {} before there is one."""
        try:
            text = (self.state / 'machines' / self.name / 'record.json').read_text()
            return dict(json.loads(text))
        except (OSError, ValueError):
            return {}


@contextlib.contextmanager
def robot(here: Place, name: str, clock: float = 0.0) -> Iterator[Robot]:
    """Yield a robot; its home goes with the block."""
    with tempfile.TemporaryDirectory(prefix='chaos-') as folder:
        (Path(folder) / 'sitecustomize.py').write_text(CLOCK)
        (Path(folder) / 'tmp').mkdir()
        yield Robot(here, name, Path(folder), clock)


def in_network(here: Place, marks: set[str]) -> Iterator[str]:
    """Yield interfaces, routes and firewall rules of these launches in the robot's network."""
    script = 'ls /sys/class/net; ip route show table all; nft list tables'
    found = subprocess.run([*here.prefix, 'sh', '-c', script], capture_output=True, text=True,
                           timeout=60, check=False)
    for line in found.stdout.splitlines():
        if any(f'fog{mark}' in line for mark in marks):
            yield f'network: {line}'


@contextlib.contextmanager
def neighbour(here: Place) -> Iterator[Callable[[], list[str]]]:
    """Run another robot's machine in a place; yield what returns what is missing of it."""
    with robot(here, 'neighbour') as its:
        run = its.launch()
        try:
            run.wait_for(UP, timeout=180.0)
            if isinstance(here, Ec2):
                here.plant('neighbour')
            before = set(here.things('neighbour'))

            def missing() -> list[str]:
                lost = before - set(here.things('neighbour'))
                before.difference_update(lost)  # each is reported once
                return sorted(lost)

            yield missing
            run.interrupt()
            run.ended(120.0)
        finally:
            run.kill()
            here.clear('neighbour')
