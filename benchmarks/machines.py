# SPDX-License-Identifier: Apache-2.0
"""How long one launch takes for 1, 4 and 16 container machines, each reaching the others."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import time

from figures import Row, write

from fogros2.deploy import Launch
from fogros2.model import MachineSpec

RUNS = 5


def bring_up(number: int) -> float:
    """Return the seconds until ``number`` machines are up."""
    launch = Launch()
    specs = [MachineSpec(f'bench-{n}', 'container') for n in range(number)]
    launch.expect([spec.name for spec in specs])
    try:
        begin = time.perf_counter()
        with ThreadPoolExecutor(number) as pool:
            list(pool.map(launch.up, specs))
        return time.perf_counter() - begin
    finally:
        failures = launch.down()
        if failures:
            raise SystemExit(f'left behind: {failures}')


def main() -> None:
    """Take the sizes in turn."""
    bring_up(1)
    times: dict[int, list[float]] = {1: [], 4: [], 16: []}
    for _ in range(RUNS):
        for number, taken in times.items():
            taken.append(bring_up(number))
    published = 'not published; its code: one after another'
    write('machines', 'Machines brought up by one launch', [
        Row.of('1 machine', times[1], 's'),
        Row.of('4 machines', times[4], 's'),
        Row.of('16 machines', times[16], 's'),
        Row.of('4 machines', [four / one for four, one in zip(times[4], times[1])], 'times one',
               published=published),
        Row.of('16 machines', [many / one for many, one in zip(times[16], times[1])],
               'times one', 5.0, published=published),
    ])


if __name__ == '__main__':
    main()
