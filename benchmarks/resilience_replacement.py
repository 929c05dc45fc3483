# SPDX-License-Identifier: Apache-2.0
"""
A spot machine that is replaced, on EC2 in a box, and the state that a killed copy loses.

The boot of an instance in the box is a container's; the box reports it, and the figure leaves it
out. The state is the time at which a node wrote its files. Machine and robot are this computer.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
import contextlib
import logging
import os
from pathlib import Path
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from types import SimpleNamespace
from typing import Any, Optional

from figures import Row, write
from launch import LaunchContext
from startup import robot

from fogros2.model import Endpoint, MachineSpec
from fogros2.shell import connect
from fogros2.waiting import wait_until
from fogros2_features.replacement.checkpoints import Checkpoints
from fogros2_features.replacement.options import Options
from rigs.launched import launching

INTERVAL, SIDE_BY_SIDE = 10.0, 5
FILES, BYTES = 20, 100_000
LAUNCH = """\
from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = AWSCloudInstance(name='bench', spot=True, on_interrupt='replace')
    words = {'package': 'fogros2_examples', 'output': 'screen'}
    return FogROSLaunchDescription([
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words)])
"""


class Writer(Checkpoints):
    """Checkpoints of a node that writes the time to all of its files when it is asked."""

    folder: Path

    async def ask(self) -> Optional[bool]:
        """Write the files."""
        now = f'{time.monotonic()} '
        for number in range(FILES):
            (self.folder / str(number)).write_text(now + 'x' * BYTES)
        return True


def serve(folder: str, store: str) -> None:
    """Make checkpoints until this process is killed."""
    loop = asyncio.new_event_loop()
    context: Any = LaunchContext()
    context._set_asyncio_loop(loop)
    session: Any = SimpleNamespace(
        spec=MachineSpec('bench', 'container'), own=Options(checkpoint_interval=INTERVAL),
        shell=connect(Endpoint('local'), name='bench'), nodes=list,
        request=lambda function: loop.create_task(function()))
    kept = Writer(session, context, Path(store), '', None, logger=logging.getLogger(),
                  in_thread=lambda *words: loop.run_in_executor(None, *words))
    kept.folder = Path(folder)
    kept.add(folder)
    loop.run_forever()


def kill(top: Path, wait: float) -> tuple[float, bool]:
    """Kill a copy ``wait`` seconds after the first snapshot; return the age of its state."""
    folder, store = top / 'map', top / 'robot'
    folder.mkdir(parents=True)
    child = subprocess.Popen(
        [sys.executable, __file__, '--serve', str(folder), str(store)], start_new_session=True)
    try:
        wait_until(lambda: [*store.glob('*/0*')] or None, timeout=120, what='a snapshot',
                   longest=0.02)
        time.sleep(wait)
        killed = time.monotonic()
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
    newest = max(store.glob('*/0*'))
    texts = [path.read_text() for path in newest.iterdir()]
    written, _, rest = texts[0].partition(' ')
    return killed - float(written), {*texts} == {texts[0]} and (
        len(texts), len(rest)) == (FILES, BYTES)


def lost(moments: int) -> Iterator[Row]:
    """Kill copies at random moments, and read their newest snapshots."""
    dice = random.Random(21)
    with tempfile.TemporaryDirectory() as top, ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        found = [*pool.map(lambda n: kill(Path(top, str(n)), dice.uniform(0.0, 2 * INTERVAL)),
                           range(moments))]
    ages = [age for age, _ in found]
    yield Row.of('state lost, median', ages, 's')
    yield Row('state lost at the most', max(ages), 's', INTERVAL, runs=moments)
    yield Row('corrupt snapshots', sum(not whole for _, whole in found), 'of all', 0,
              runs=moments)


def replaced(runs: int) -> Iterator[Row]:
    """Measure from the spot notice to the first message of the replacement."""
    boots, beyond, robots = [], [], []
    for _ in range(runs):
        with robot(bare=False) as here, launching() as launch:
            path = here.home / 'replaced.launch.py'
            path.write_text(LAUNCH)
            run = launch(str(path), environment=here.environment, prefix=here.box.on_robot([]))
            run.wait_for('I heard: [Hello World from bench ', timeout=300.0)
            begin = time.monotonic()
            here.box.interrupt(here.box.alive()[0].id, notice=120.0)
            run.wait_for(f'I heard: [Hello World from {os.uname().nodename} ')
            run.wait_for('bench: a new machine runs the nodes', timeout=300.0)
            moved = run.since(begin, 'bench: a new machine runs')[0][0]
            heard = 'I heard: [Hello World from bench '
            run.wait_for(heard, times=run.text.count(heard) + 1)
            first = run.since(moved, heard)[0][0]
            newest = here.box.instances()[-1]
            boots.append(newest.ready - newest.asked)
            beyond.append(first - begin - boots[-1])
            robots.append(run.since(begin, f'from {os.uname().nodename} ')[0][0] - begin)
            print(*(line for line in run.said if re.search('machine|seconds| s$', line)))
            run.interrupt()
            run.ended(120.0)
    yield Row.of('spot notice to the first message of the robot', robots, 's')
    yield Row.of('boot of the replacement', boots, 's')
    yield Row.of('spot notice to the first message of the replacement, beyond the boot', beyond,
                 's', 10.0)


def main() -> None:
    """Take the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--serve', nargs=2)
    parser.add_argument('--moments', type=int, default=50)
    parser.add_argument('--runs', type=int, default=3)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(*arguments.serve)
        return
    rows = [*(lost(arguments.moments) if arguments.moments else ()),
            *(replaced(arguments.runs) if arguments.runs else ())]
    write('resilience_replacement', 'A machine that is replaced, and its checkpoints', rows)


if __name__ == '__main__':
    main()
