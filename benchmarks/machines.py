# SPDX-License-Identifier: Apache-2.0
"""How long one launch takes for 1, 4 and 16 container machines, each reaching the others."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import statistics
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
    one, four, sixteen = (statistics.median(taken) for taken in times.values())
    published = 'not published; its code: one after another'
    write('machines', 'Machines brought up by one launch', [
        Row('1 machine', one, 's', runs=RUNS),
        Row('4 machines', four, 's', runs=RUNS),
        Row('16 machines', sixteen, 's', runs=RUNS),
        Row('4 machines', four / one, 'times one', published=published, runs=RUNS),
        Row('16 machines', sixteen / one, 'times one', 5.0, published=published, runs=RUNS),
    ])


if __name__ == '__main__':
    main()
