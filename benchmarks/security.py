# SPDX-License-Identifier: Apache-2.0
"""
How the promises of ``doc/security.md`` hold against inputs that nobody sent on purpose.

``fuzz`` feeds mutated inputs to each reader of others' inputs for ``--minutes``. ``secrets``
launches a machine of each provider for a user with planted credentials, and looks for these and
for the launch's own keys in arguments, variables, logs, store, tags, user data and files.

    python benchmarks/security.py [fuzz] [secrets] [--minutes 10] [--seed 1]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import json
from pathlib import Path
import subprocess
import sys

from figures import Row, write
from figures.places import place
from figures.secrets_scan import scan

from rigs.fuzz_targets import TARGETS

NOTES = Path('.cache/fuzz')


def fuzz(seed: int, seconds: float) -> Iterator[Row]:
    """Yield what became of the inputs of each target; what went wrong is kept in a folder."""
    NOTES.mkdir(parents=True, exist_ok=True)
    for target in TARGETS:
        note = NOTES / target.replace(' ', '-')
        child = subprocess.run(
            [sys.executable, '-m', 'rigs.fuzzing', target, str(seed), '--seconds', str(seconds),
             '--note', str(note)], capture_output=True, text=True, check=False)
        if child.returncode:
            print(f'{target}: crashed by {note}:\n{child.stderr[-2000:]}')
            yield Row(f'{target}: crashes', 1, 'inputs', 0.0)
            continue
        result = json.loads(child.stdout)
        for wrong, data in result['found'].items():
            print(f'{target}: {wrong}: {data[:2000]}')
        yield Row(f'{target}: crashes, hangs, unexpected errors', len(result['found']), 'inputs',
                  0.0, runs=result['done'])
        yield Row(f'{target}: memory', result['peak'] / 1e6, 'MB', 500.0)


def secrets(provider: str) -> Iterator[Row]:
    """Yield where secrets were found with a provider, and whether the scan saw each source."""
    with place(provider) as here:
        sees, leaks, count = scan(here)
    for line in leaks:
        print(f'{provider}: {line}')
    blind = [kind for kind, seen in sees.items() if not seen]
    print(f'{provider}: {count} sources, {sees}')
    yield Row(f'{provider}: secrets found', len(leaks), 'places', 0.0, runs=count)
    yield Row(f'{provider}: kinds of sources in which the scan saw a known word',
              len(sees) - len(blind), 'kinds', float(len(sees)), better='more')


def main() -> None:
    """Take the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('parts', nargs='*', help='fuzz, secrets (default: both)')
    parser.add_argument('--minutes', type=float, default=10.0, help='for each reader of inputs')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--provider', action='append')
    given = parser.parse_args()
    parts = given.parts or ['fuzz', 'secrets']
    if 'fuzz' in parts:
        write('fuzzing', f'Mutated inputs for {given.minutes:g} minutes each, seed {given.seed}',
              list(fuzz(given.seed, 60 * given.minutes)))
    if 'secrets' in parts:
        write('secrets', 'Planted credentials and own keys where others could read them', [
            row for provider in given.provider or ('container', 'aws', 'kubernetes')
            for row in secrets(provider)])


if __name__ == '__main__':
    main()
