# SPDX-License-Identifier: Apache-2.0
"""
How the promises of ``doc/developers/security.md`` hold against inputs that nobody sent on purpose.

``fuzz`` feeds mutated inputs to each reader of others' inputs for ``--minutes``, guided by
coverage where the reader is Python code in one process. ``secrets`` launches a machine of each
provider for a user with planted credentials, and looks for these and for the launch's own keys in
arguments, variables, logs, store, tags, user data and files. ``strangers`` launches a machine of
each, and sends ``--packets`` to the open ports of the machine, and a quarter of that to the robot.

    python benchmarks/security.py [fuzz] [secrets] [strangers] [--minutes 10] [--seed 1]

With ``--provider``, the figures of the other providers stay as they are.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import json
from pathlib import Path
import subprocess
import sys

from figures import machine, RESULTS, Row, write
from figures.places import place
from figures.secrets_scan import scan
from figures.strangers import attack, CONTROL

from rigs.fuzz_targets import PYTHON, TARGETS

NOTES = Path('.cache/fuzz')
#: All, and those whose firewall the strangers' benchmark can open.
PROVIDERS = ('container', 'aws', 'gcp', 'azure', 'kubernetes', 'ssh')
ADMITTING = ('container', 'aws', 'kubernetes', 'ssh')


def fuzz(seed: int, seconds: float) -> Iterator[Row]:
    """Yield what became of the inputs of each target; what went wrong is kept in a folder."""
    NOTES.mkdir(parents=True, exist_ok=True)
    for target in TARGETS:
        note = NOTES / target.replace(' ', '-')
        child = subprocess.run(
            [sys.executable, '-m', 'rigs.fuzzing', target, str(seed), '--seconds', str(seconds),
             '--note', str(note), *(['--guided'] if target in PYTHON else [])],
            capture_output=True, text=True, check=False)
        if child.returncode:
            print(f'{target}: crashed by {note}:\n{child.stderr[-2000:]}')
            yield Row(f'{target}: crashes', 1, 'inputs', 0.0)
            continue
        result = json.loads(child.stdout.splitlines()[-1])  # Atheris prints a line before
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


def strangers(provider: str, packets: int, seed: int) -> Iterator[Row]:
    """Yield what strangers got from the machine and the robot of a launch."""
    with place(provider) as here:
        found = attack(here, packets, seed)
    print(f'{provider}: {found}', flush=True)
    yield Row(f'{provider}: replies to a stranger', sum(found.replies.values()), 'packets', 0.0,
              runs=found.sent)
    yield Row(f"{provider}: WireGuard's cookie replies", found.cookies, 'packets', runs=found.sent)
    aside = {'container': ', its SSH server aside', 'ssh': ', those of before the launch aside'}
    yield Row(f"{provider}: TCP ports that accept a stranger{aside.get(provider, '')}",
              len(found.accepted), 'ports', 0.0)
    yield Row(f'{provider}: UDP ports that were open on machine and robot', len(found.ports),
              'ports')
    yield Row(f'{provider}: replies of a socket that echoes', min(found.control), 'packets', 1.0,
              better='more', runs=CONTROL)
    yield Row(f'{provider}: packets dropped unread', found.dropped, 'packets', runs=found.sent)
    yield Row(f'{provider}: problems of launch, VPN and machine afterwards', len(found.problems),
              'problems', 0.0)


def record(name: str, title: str, providers: Sequence[str], rows: Sequence[Row]) -> None:
    """Write the rows of some providers beside the earlier rows of the others."""
    path = RESULTS / f'{name}.json'
    before = json.loads(path.read_text()) if path.exists() else {'rows': []}
    kept = [Row(**row) for row in before['rows'] if row['what'].partition(':')[0] not in providers]
    rows = sorted([*rows, *kept], key=lambda row: PROVIDERS.index(row.what.partition(':')[0]))
    earlier = dict.fromkeys(row.what.partition(':')[0] for row in rows if row in kept)
    computer = f"{machine()}; {', '.join(earlier)}: {before['machine']}, {before['date']}"
    write(name, title, rows, computer=computer if kept else '')


def main() -> None:
    """Take the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('parts', nargs='*', help='fuzz, secrets, strangers (default: all)')
    parser.add_argument('--minutes', type=float, default=10.0, help='for each reader of inputs')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--packets', type=int, default=10**6, help='of strangers to each machine')
    parser.add_argument('--provider', action='append', choices=PROVIDERS)
    given = parser.parse_args()
    parts = given.parts or ['fuzz', 'secrets', 'strangers']
    providers = given.provider or PROVIDERS
    admitting = [provider for provider in providers if provider in ADMITTING]
    if 'fuzz' in parts:
        write('fuzzing', f'Mutated inputs for {given.minutes:g} minutes each, seed {given.seed}',
              list(fuzz(given.seed, 60 * given.minutes)))
    if 'secrets' in parts:
        record('secrets', 'Planted credentials and own keys where others could read them',
               providers, [row for provider in providers for row in secrets(provider)])
    if 'strangers' in parts:
        record('strangers', f'Packets of strangers, seed {given.seed}', admitting, [
            row for provider in admitting
            for row in strangers(provider, given.packets, given.seed)])


if __name__ == '__main__':
    main()
