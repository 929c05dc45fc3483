# SPDX-License-Identifier: Apache-2.0
"""
What is left after ``ros2 launch`` was killed with SIGKILL at a random moment.

For each kill a new robot launches a talker on a machine of its own, and is killed at a moment that
the seed, the provider and the kill's number decide, most often while the machine is created. Its
clock may be an hour ahead or behind. ``ros2 fog gc`` runs once: after the machine had its time to
end by itself, or at once. A neighbour's machine in the same place has to survive all of it.
Time-outs are seconds, unless ``--defaults`` asks for those of the product.

    python benchmarks/chaos.py [--provider container|aws|kubernetes] [--kills 100] [--minutes 30]

Results are appended to a file (``--state``): a run continues where another one with the same seed
ended. The figures are written when all kills that were asked for are done.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
import dataclasses
import json
import os
from pathlib import Path
import random
import signal
import sys
import time
from typing import Any

from figures import Row, write
from figures.places import Place, place
from figures.robots import in_network, neighbour, Robot, robot, UP

from fogros2.waiting import wait_until
from rigs.launched import Launched
from rigs.traces import RUN, Traces

PROVIDERS = ('container', 'aws', 'kubernetes')
#: Parts of a launch, and how often a kill falls into each.
PARTS = {'start': 0.15, 'creation': 0.5, 'arming': 0.25, 'running': 0.1}
HOUR = 3600.0
#: Seconds by which a busy computer may be late.
SLACK = 10.0
#: Seconds without a machine after which none is still being created.
QUIET = 5.0


@dataclasses.dataclass(frozen=True)
class Kill:
    """
    What is decided about a kill before its launch starts.

    :param fraction: of the part's usual duration, 0 to 1.
    :param clock: seconds by which the robot's clock is ahead.
    :param patient: whether gc waits until the machine had its time to end by itself.
    """

    number: int
    part: str
    fraction: float
    clock: float
    patient: bool


def draw(seed: int, provider: str, number: int) -> Kill:
    """Return the kill of that number; the same for the same arguments."""
    dice = random.Random(f'{seed} {provider} {number}')
    part, = dice.choices(list(PARTS), list(PARTS.values()))
    return Kill(number, part, dice.random(), dice.choice((-HOUR, 0.0, HOUR)),
                dice.random() < 0.5)


@dataclasses.dataclass(frozen=True)
class Pace:
    """Usual seconds of the parts of a launch in one place."""

    start: float
    creation: float
    arming: float
    running: float = 5.0


def begun(its: Robot, run: Launched, part: str) -> bool:
    """Wait until a part of a launch begins; return whether the launch goes on."""
    tells: Mapping[str, Callable[[], object]] = {
        'start': lambda: True, 'creation': its.record,
        'arming': lambda: its.record().get('machine_id'), 'running': lambda: UP in run.text}
    wait_until(lambda: run.child.poll() is not None or bool(tells[part]()), timeout=180.0,
               longest=0.005, what=f'the part {part} of the launch')
    return run.child.poll() is None


def measure(here: Place) -> Pace:
    """Return how long an undisturbed launch takes; the second one, as the first fills caches."""
    for name in ('chaos-first', 'chaos-second'):
        with robot(here, name) as its:
            begin = time.monotonic()
            run, at = its.launch(), []
            try:
                for part in PARTS:
                    if not begun(its, run, part):
                        raise SystemExit(f'the launch failed:\n{run.text}')
                    at.append(time.monotonic() - begin)
                run.interrupt()
                run.ended(120.0)
            finally:
                run.kill()
    _, created, made, up = at
    return Pace(created, made - created, up - made)


def strike(here: Place, pace: Pace, kill: Kill, name: str) -> dict[str, Any]:
    """Carry out a kill; return what it was, which machines lived on, and what gc left."""
    with robot(here, name, kill.clock) as its:
        its.state.mkdir()
        traces = Traces(its.state, its.home / 'none', its.environment[RUN])
        run = its.launch()
        try:
            begun(its, run, kill.part)
            time.sleep(kill.fraction * getattr(pace, kill.part))
            failed = run.child.poll() is not None
            run.child.send_signal(signal.SIGKILL)
            run.child.wait()
            struck = time.monotonic()
            traces.note()
            lives = its.record()
            said = '' if kill.patient else its.gc()
            last, alive = last_life(
                here, name, here.bound + SLACK - (time.monotonic() - struck))
            if kill.patient:
                said = its.gc()
            left = {*here.things(name), *in_network(here, traces.marks),
                    # prices may stay; files in /tmp are others', this robot's are in its home
                    *(what for what in traces.left()
                      if not what.startswith(('file ', 'state cache/'))),
                    *(f'tmp/{path.name}' for path in (its.home / 'tmp').glob('fogros2*'))}
            return {**dataclasses.asdict(kill), 'alive': alive, 'left': sorted(left),
                    'ended': round(last - struck, 1), 'failed': run.text if failed else '',
                    'gc': said if alive or left else '',
                    'record': lives if alive or left else {}}
        finally:
            run.kill()
            here.clear(name)


def last_life(here: Place, name: str, timeout: float) -> tuple[float, list[str]]:
    """
    Wait until no machine of that name has run for ``QUIET`` seconds.

    :returns: when a machine ran last (monotonic), and the machines that run after ``timeout`` s.
    """
    last = end = time.monotonic()
    end += timeout
    while True:
        alive = [thing for thing, runs in here.things(name).items() if runs]
        now = time.monotonic()
        last = now if alive else last
        if now > end or now - last > QUIET:
            return last, alive
        time.sleep(0.5)


def numbers(done: list[dict[str, Any]], provider: str, kills: int) -> list[int]:
    """Return the numbers of the kills that are still to be done."""
    there = {each['number'] for each in done if each['provider'] == provider}
    return [number for number in range(kills) if number not in there]


def kill_all(
    provider: str, state: Path, options: argparse.Namespace, until: float,
) -> None:
    """Carry out the kills of a provider that are still to be done, until a time."""
    left = numbers(read(state), provider, options.kills)
    if not left or time.monotonic() > until:
        return
    with place(provider, short=not options.defaults) as here:
        pace = measure(here)
        print(f'{provider}: {pace}', flush=True)
        with neighbour(here) as missing, ThreadPoolExecutor(options.at_once) as pool:
            while left and time.monotonic() < until:
                batch, left = left[:options.at_once], left[options.at_once:]
                found = list(pool.map(lambda number: strike(
                    here, pace, draw(options.seed, provider, number),
                    f'chaos-{os.getpid()}-{number}'), batch))
                found[0]['neighbour'] = missing()
                with open(state, 'a') as file:
                    for each in found:
                        file.write(json.dumps({'provider': provider, **each}) + '\n')
                        print(provider, {key: value for key, value in each.items() if value},
                              flush=True)


def read(state: Path) -> list[dict[str, Any]]:
    """Return the kills that are done."""
    return [json.loads(line) for line in state.read_text().splitlines()] \
        if state.exists() else []


def left(kill: Mapping[str, Any]) -> list[str]:
    """Return what one gc has left, but for the records of requests without an answer."""
    return [thing for thing in kill['left'] if not thing.startswith('state requests/')]


def rows(done: list[dict[str, Any]]) -> Iterator[Row]:
    """Yield the figures of each provider."""
    for provider in PROVIDERS:
        its = [each for each in done if each['provider'] == provider]
        if its:
            for what, things in (
                    ('machines alive after their time', [each['alive'] for each in its]),
                    ('things left after one gc', [left(each) for each in its]),
                    ("a neighbour's things deleted", [each.get('neighbour', ()) for each in its])):
                yield Row(f'{provider}: {what}', sum(map(len, things)), 'things', 0.0,
                          runs=len(its))
            # by design: the machine of such a request may still appear
            yield Row(f'{provider}: requests without an answer, for a gc after 15 minutes',
                      sum(len(each['left']) - len(left(each)) for each in its), 'requests',
                      runs=len(its))
            yield Row(f'{provider}: longest life after the kill',
                      max(each['ended'] for each in its), 's', runs=len(its))


def main() -> None:
    """Kill launches, and write down what was left."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--provider', choices=PROVIDERS)
    parser.add_argument('--kills', type=int, default=0, help='of each provider (default: 100)')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--at-once', type=int, default=2)
    parser.add_argument('--minutes', type=float, default=1e6, help='begin no kill after these')
    parser.add_argument('--defaults', action='store_true', help='5 kills, default time-outs')
    parser.add_argument('--state', type=Path)
    options = parser.parse_args()
    options.kills = options.kills or (5 if options.defaults else 100)
    name = 'chaos-defaults' if options.defaults else 'chaos'
    state = options.state or Path(f'.cache/{name}-{options.seed}.jsonl')
    state.parent.mkdir(parents=True, exist_ok=True)
    print(f'seed {options.seed}, results in {state}', flush=True)
    until = time.monotonic() + 60 * options.minutes
    for provider in [options.provider] if options.provider else PROVIDERS:
        kill_all(provider, state, options, until)
    done = read(state)
    pace = 'default' if options.defaults else 'short'
    write(name, f'ros2 launch killed at random moments, {pace} time-outs, seed {options.seed}',
          list(rows(done)))
    sys.exit(any(each['alive'] or left(each) or each.get('neighbour') for each in done))


if __name__ == '__main__':
    main()
