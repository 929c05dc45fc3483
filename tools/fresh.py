#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Run the README's commands on newly installed systems, and write what became of them.

    tools/fresh.py [VARIANT...]       default: all; results go to benchmarks/results/fresh.md
    tools/fresh.py -- COMMAND...      run one command and return its exit status

The commands run at HEAD: changes that are not committed are not in it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
import datetime
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import signal
import sys
import time
from typing import Any, Optional

from clean_system import clean_system, CleanSystemError, commit_of, say, Suite, System
import closing_line
import leftovers

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'benchmarks' / 'results'
#: Keeps systems, packages and running roots. It must lie on a disk: an overlay carries no other.
FOLDER = Path(os.environ.get('FOGROS2_FRESH_FOLDER') or Path(
    os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2/fresh'))
#: Where tools/kubernetes.sh has built Kubernetes, such as ~/.cache/fogros2/kubernetes: a COMMAND
#: that tests with a cluster need not build it.
KUBERNETES = os.environ.get('FOGROS2_FRESH_KUBERNETES', '')
BOOKWORM, TRIXIE = Suite('bookworm', 'Debian 12'), Suite('trixie', 'Debian 13')
NOBLE = Suite('noble', 'Ubuntu 24.04', 'ubuntu', os.environ.get('FOGROS2_UBUNTU_MIRROR', ''))
#: The part of the tests that needs no machines, in place of all of them.
FAST = {'make test': 'make test-fast'}
#: What no such system can show, and why.
NOT_HERE = {
    'tests as root': 'the user is not root: tests that become other users are skipped by name',
    'systemd': 'the first process is a shell: no service is masked or started, no timer runs',
    'kernel modules': "the kernel is this computer's: WireGuard is wireguard-go where it has none",
    'ROS 2 Jazzy': 'no release of Debian has it as packages: its wheels are tested',
}


@dataclasses.dataclass(frozen=True)
class Variant:
    """
    A system, and which of the README's commands run there.

    :param password: whether sudo asks the user for one.
    :param whole: whether all tests run.
    """

    name: str
    suite: Suite
    password: bool
    whole: bool = False

    def commands(self, readme: str) -> list[str]:
        """Return the commands of a README for this system: in order, or the tests first."""
        commands = readme_commands(readme)
        if self.whole:
            return commands
        # the tests' set-up then finds a system without Python
        return [FAST.get(command, command) for command in reversed(commands)]


VARIANTS = {variant.name: variant for variant in (
    Variant('debian-12-password', BOOKWORM, password=True, whole=True),
    Variant('debian-12', BOOKWORM, password=False),
    Variant('debian-13', TRIXIE, password=False),
    *([Variant('ubuntu-24.04', NOBLE, password=True)] if NOBLE.mirror else ()))}


def readme_commands(readme: str) -> list[str]:
    """Return the commands of the first ``console`` block of a README."""
    found = re.search(r'```console\n(.*?)```', readme, re.DOTALL)
    assert found, 'the README shows no command'
    return [line[2:].partition('#')[0].strip() for line in found[1].splitlines()
            if line.startswith('$ ')]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """
    What became of one command.

    :param packages: how many were installed.
    :param downloaded: bytes, those included that an earlier run had downloaded.
    :param tests: passed, failed, skipped; None where no tests ran.
    :param failed: names of tests; ``skipped`` the reasons, each with the names of its tests.
    :param left: leftovers, a line each.
    """

    system: str
    password: bool
    command: str
    commit: str
    date: str
    status: int
    packages: int
    downloaded: int
    minutes: float
    tests: Optional[tuple[int, int, int]]
    failed: Sequence[str]
    skipped: Mapping[str, Sequence[str]]
    left: Sequence[str]


def run_variant(variant: Variant, commit: str, logs: Path) -> list[Outcome]:
    """Run a variant's commands in one system, in order, and return what became of each."""
    outcomes = []
    with clean_system(
            FOLDER, variant.suite, ROOT, commit, password=variant.password) as system:
        for command in variant.commands((ROOT / 'README.md').read_text()):
            say(f'{variant.suite.title}: {command}')
            outcomes.append(run_command(system, variant, commit, command, logs))
    return outcomes


def run_command(
    system: System, variant: Variant, commit: str, command: str, logs: Path,
) -> Outcome:
    """Run one command and compare the system before and after it."""
    logs.mkdir(parents=True, exist_ok=True)
    packages, received = system.packages(), system.received()
    before, begin = leftovers.look(system), time.time()
    with open(logs / f'{command.replace(" ", "-")}.log', 'w') as log:
        status = system.type(command, [sys.stdout, log], password=variant.password)
    minutes = (time.time() - begin) / 60
    new = [file for name, file in system.packages().items() if packages.get(name) != file]
    reports = [path for path in sorted((system.project / '.cache').glob('test-*.xml'))
               if path.stat().st_mtime > begin]
    copy_results(system.project, logs)
    tests = closing_line.read(reports)
    return Outcome(
        system=variant.suite.title, password=variant.password, command=command,
        commit=commit, date=datetime.date.today().isoformat(), status=status,
        packages=len(new), minutes=round(minutes, 1),
        downloaded=system.received() - received + system.saved(new) + local_wheels(
            system.project / '.cache/setup.log', begin),
        tests=tests.counts if reports else None, failed=tests.failed, skipped=tests.skipped,
        left=leftovers.after(system, before))


def local_wheels(log: Path, since: float) -> int:
    """Return the bytes that pip took from folders of this computer, in place of its index."""
    if not log.exists() or log.stat().st_mtime < since:
        return 0
    paths = {Path(path) for path in re.findall(r'Processing (/\S+\.whl)', log.read_text())}
    return sum(path.stat().st_size for path in paths if path.exists())


def copy_results(project: Path, target: Path) -> None:
    """Copy the tests' reports and the logs of the set-up."""
    target.mkdir(parents=True, exist_ok=True)
    for pattern in ('*.xml', '*.log'):
        for path in (project / '.cache').glob(pattern):
            shutil.copy(path, target)


def table(outcomes: Sequence[Mapping[str, Any]]) -> str:
    """Return the page of all outcomes."""
    lines = [
        '# On newly installed systems', '',
        'What `make fresh` measured. debootstrap makes each system, with `sudo`, `git`, `make`',
        'and a user; the commands are those of the README. "Downloaded" also counts packages that',
        'an earlier run had kept.', '',
        '| System | sudo | Command | Packages | Downloaded | Minutes | Passed | Failed | Skipped '
        '| Left behind |', '|---|---|---|---|---|---|---|---|---|---|']
    for row in outcomes:
        tests = row['tests'] or ('', '', '')
        ended = '' if row['status'] == 0 else f' (**exit status {row["status"]}**)'
        lines.append('| ' + ' | '.join(map(str, (
            row['system'], 'with a password' if row['password'] else 'without a password',
            f'`{row["command"]}`{ended}', row['packages'], f'{row["downloaded"] / 1e6:.0f} MB',
            row['minutes'], *tests, f'{len(row["left"])}, see below' if row['left'] else 'nothing',
        ))) + ' |')
    for row in outcomes:
        notes = [*(f'- failed: `{name}`' for name in row['failed']),
                 *(f'- left behind: {trace}' for trace in row['left']),
                 *(f'- skipped, {reason}: {", ".join(f"`{name}`" for name in names)}'
                   for reason, names in row['skipped'].items())]
        lines += ['', f'## {row["system"]}: `{row["command"]}`', '',
                  f'At {row["commit"][:12]}, {row["date"]}.', '', *(notes or ['- every test ran'])]
    lines += ['', leftovers.NOT_COUNTED, '', '## What such a system cannot show', '',
              *(f'- {name}: {why}.' for name, why in NOT_HERE.items())]
    return '\n'.join(lines) + '\n'


def record(outcomes: Sequence[Outcome], results: Path = RESULTS) -> None:
    """Write new outcomes in place of earlier ones of the same systems."""
    path = results / 'fresh.json'
    rows = json.loads(path.read_text()) if path.exists() else []
    new = {(each.system, each.password) for each in outcomes}
    rows = [row for row in rows if (row['system'], row['password']) not in new]
    rows += json.loads(json.dumps([dataclasses.asdict(each) for each in outcomes]))
    rows.sort(key=lambda row: (row['system'], not row['password']))
    path.write_text(json.dumps(rows, indent=2) + '\n')
    (results / 'fresh.md').write_text(table(rows))


def interrupt(number: int, frame: Any) -> None:
    """End in order at the first signal; the next ones would cut that short."""
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)
    sys.exit(128 + number)


def main(words: Sequence[str]) -> int:
    """Run what the command line names; return 1 if something failed or was left behind."""
    own, command = list(words), []
    if '--' in own:
        own, command = own[:own.index('--')], own[own.index('--') + 1:]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('variants', nargs='*', metavar='VARIANT', help=', '.join(VARIANTS))
    parser.add_argument('--suite', choices=[each.name for each in (BOOKWORM, TRIXIE, NOBLE)],
                        default='bookworm', help='where COMMAND runs')
    parser.add_argument('--password', action=argparse.BooleanOptionalAction, default=True,
                        help='whether sudo asks for a password, which is then typed')
    parser.add_argument('--repository', type=Path, default=ROOT, help='where COMMAND is from')
    parser.add_argument('--commit', default='HEAD')
    parser.add_argument('--results', type=Path, help="folder for the tests' reports and logs")
    options = parser.parse_args(own)
    unknown = set(options.variants) - set(VARIANTS)
    if unknown:
        parser.error(f'no variant {", ".join(sorted(unknown))}; there are {", ".join(VARIANTS)}')
    if KUBERNETES and not any(Path(KUBERNETES).glob('*/built')):
        parser.error(f'FOGROS2_FRESH_KUBERNETES: {KUBERNETES} has no build of Kubernetes')
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, interrupt)
    try:
        if command:
            suite = {each.name: each for each in (BOOKWORM, TRIXIE, NOBLE)}[options.suite]
            return run_one(command, suite, options)
        good = True
        for variant in [VARIANTS[name] for name in options.variants or VARIANTS]:
            outcomes = run_variant(variant, commit_of(ROOT, options.commit),
                                   (options.results or FOLDER / 'results') / variant.name)
            record(outcomes)
            good &= all(each.status == 0 and not each.left for each in outcomes)
        print((RESULTS / 'fresh.md').read_text())
        return 0 if good else 1
    except CleanSystemError as error:
        print(f'** {error}', file=sys.stderr)
        return 1


def run_one(command: Sequence[str], suite: Suite, options: argparse.Namespace) -> int:
    """Run one command and return its exit status."""
    line = command[0] if len(command) == 1 else shlex.join(command)
    commit = commit_of(options.repository, options.commit)
    with clean_system(
        FOLDER, suite, options.repository, commit, password=options.password,
        kubernetes=KUBERNETES,
    ) as system, contextlib.ExitStack() as after:
        if options.results is not None:
            after.callback(copy_results, system.project, options.results)
        return system.type(line, [sys.stdout], password=options.password)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
