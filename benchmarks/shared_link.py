# SPDX-License-Identifier: Apache-2.0
"""
Three VGA cameras at 30 Hz and a lidar at 10 Hz on a link of 40 Mbit/s, with and without a budget.

The nodes are those of ``streaming`` and ``point_clouds``. A node on a container machine, behind a
relay that limits the link, answers each image and scan. ``--short`` takes a tenth of the images.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import statistics
import subprocess
import sys
import time
from typing import Any

from figures import machine as computer
from figures import RESULTS, Row, write
import point_clouds
import streaming
from streaming import answer_of, end, FOLDER, HERE, launched, Link, Output, ROOT

LINK = 40e6
LINK_TOPIC = '/fogros2/machine/link_in'
STREAMS = ('left', 'front', 'right', 'points')
SIZE = ('--width', '640', '--height', '480')


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a stream came to: messages that arrived per second, round trips in ms."""

    case: str
    stream: str
    rate: float
    median: float
    p95: float
    limit: float


def pair(stream: str, role: str, limited: bool) -> list[str]:
    """Return the command line of a stream's encoder or decoder."""
    cloud = stream == 'points'
    package = 'point_cloud_stream' if cloud else 'image_transport_h264'
    words = [sys.executable, '-c', f'from {package}.{role} import main; main()', '--ros-args',
             '-r', f'__node:={stream}_{role}', '-p', f'stream:=/{stream}/coded', '-r',
             f"{'points' if cloud else 'image'}:=/{'decoded_' * (role == 'decoder')}{stream}"]
    if role == 'encoder' and cloud:
        words += ['-p', f'resolution:={point_clouds.RESOLUTION}']
    if role == 'decoder' and limited:
        words += ['-p', f'links:={LINK_TOPIC}={LINK}']
    return words


def program(folder: Any, stream: str, *words: str) -> list[str]:
    """Return the command line of a camera, of the lidar, or of the node that answers."""
    file = 'point_clouds.py' if stream == 'points' else 'streaming.py'
    size = () if stream == 'points' else SIZE
    source = 'points' if stream == 'points' else 'camera'
    return [sys.executable, f'{folder}/{file}', *words, *size, '--ros-args', '-r',
            f'{source}:=/{stream}', '-r', f'answer:=/{stream}/answer', '-r',
            f'__node:={stream}_{words[0].strip("-")}']


def run(case: str, limited: bool, launch: Any, machine: Any, link: Link, output: Output,
        count: int, parts: dict[str, float]) -> list[Outcome]:
    """Run all streams at once, and return what each came to."""
    from fogros2.model import NodeSpec
    from fogros2.waiting import wait_until

    environment = {**os.environ, **launch.robot_environment(), 'PYTHONPATH': str(ROOT)}
    there = {'PYTHONPATH': FOLDER}
    link.change(rate=LINK)
    nodes = []
    for stream in STREAMS:
        answering = program(FOLDER, stream, '--cloud', '--topic', f'/decoded_{stream}', '--result',
                            f'{FOLDER}/{stream}.npz')
        for role, words in (('decoder', pair(stream, 'decoder', limited)), ('cloud', answering)):
            name = f'{stream}-{role}-{limited:d}'
            nodes.append(NodeSpec(name, name, arguments=tuple(words), environment=there))
        machine.shell.put(b'', f'{FOLDER}/{stream}.npz', mode=0o666)
    machine.start(nodes)
    processes: list[subprocess.Popen[Any]] = []
    sources: dict[str, subprocess.Popen[str]] = {}
    outcomes = []
    try:
        for stream in STREAMS:
            # not in this folder, whose rclpy.py is no rclpy
            processes.append(subprocess.Popen(
                pair(stream, 'encoder', limited), env=environment, cwd=ROOT))
            points = stream == 'points'
            role = '--lidar' if points else '--camera'
            sources[stream] = subprocess.Popen(
                program(HERE, stream, role, '--count', str(count // 3 if points else count)),
                env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for stream, source in sources.items():
            told = answer_of(source, stream, count / streaming.RATE + 180)
            trips = told['times'] if 'times' in told else [
                trip for _, trip in told['trips'] if math.isfinite(trip)]
            times = sorted(1e3 * trip for trip in trips) or [math.nan]
            outcomes.append(Outcome(
                case, stream, len(trips) / told['seconds'], statistics.median(times),
                times[min(len(times) - 1, int(0.95 * len(times)))], parts[stream]))
    finally:
        for process in (*sources.values(), *processes):
            end(process)
        machine.stop([node.id for node in nodes])
        wait_until(lambda: {node.id for node in nodes} <= output.ended, timeout=60.0,
                   what='the nodes on the machine to end')
        link.change(rate=0.0)
    return outcomes


def limits() -> dict[str, float]:
    """Return the round trips that are possible, in ms: parts measured alone, and the wire."""
    _, size, there, back, _ = point_clouds.alone()[0]
    cloud = 2 * point_clouds.hop_alone() + there + back + 1e3 * size * 8 / LINK
    image = 2 * streaming.hop_alone('VGA') + sum(streaming.codec_alone('VGA'))
    # 2.3 kB of a picture take 0.5 ms, less than the error of the other parts
    return {stream: cloud if stream == 'points' else image for stream in STREAMS}


def table(outcomes: list[Outcome], note: str) -> str:
    """Return the table as Markdown."""
    lines = ['# Several streams on one link, whose two ends share two cores', '', note, '',
             '| | stream | Hz | round trip, ms: median | p95 | limit |', '|---' * 6 + '|']
    lines += [f'| {o.case} | {o.stream} | {o.rate:.2f} | {o.median:.1f} | {o.p95:.1f} | '
              f'{o.limit:.1f} |' for o in outcomes]
    return '\n'.join([*lines, ''])


def main() -> None:
    """Measure both cases, write the figures down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--short', action='store_true')
    parser.add_argument('--count', type=int, default=1800)
    arguments = parser.parse_args()
    count = arguments.count // 10 if arguments.short else arguments.count
    outcomes: list[Outcome] = []
    begin = time.monotonic()
    parts = limits()
    with launched('bench-link', point_clouds.prepare) as (launch, machine, link, output):
        for case, limited in (('budget of 40 Mbit/s', True), ('no budget', False)):
            outcomes += run(case, limited, launch, machine, link, output, count, parts)
    text = table(outcomes, f'{computer()}; {count} images of each camera, {count // 3} scans; '
                 f'link of {LINK / 1e6:.0f} Mbit/s.')
    print(text)
    print(f'took {(time.monotonic() - begin) / 60:.1f} min')
    if arguments.short:
        return
    rows = []
    for o in outcomes:
        points, goal = o.stream == 'points', o.case != 'no budget'
        name = f'{o.case}: {o.stream}'
        rows += [Row(f'{name}: rate', o.rate, '1/s', (9.95 if points else 29.9) if goal else None,
                     'more', runs=1),
                 Row(f'{name}: p95', o.p95, 'ms', (120.0 if points else 40.0) if goal else None,
                     runs=1)]
    write('shared_link', 'Several streams on one link, whose two ends share two cores', rows)
    (RESULTS / 'shared_link-table.md').write_text(text)


if __name__ == '__main__':
    main()
