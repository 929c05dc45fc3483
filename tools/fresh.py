# SPDX-License-Identifier: Apache-2.0
"""Run commands in a newly installed system."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import shlex
import shutil
import signal
import sys
from typing import Any

from clean_system import clean_system, CleanSystemError, Suite

ROOT = Path(__file__).resolve().parents[1]
SUITES = {suite.name: suite for suite in (
    Suite('bookworm', 'Debian 12'),
    Suite('trixie', 'Debian 13'),
    Suite('noble', 'Ubuntu 24.04', 'ubuntu', os.environ.get('FOGROS2_UBUNTU_MIRROR', '')))}
#: Keeps systems, packages and running roots; must lie on a real disk, not on an overlay.
FOLDER = Path(os.environ.get('FOGROS2_FRESH_FOLDER') or Path(
    os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2/fresh'))
#: A folder with Kubernetes as tools/kubernetes.sh builds it, to save these ten minutes.
KUBERNETES = Path(os.environ['FOGROS2_FRESH_KUBERNETES']) \
    if os.environ.get('FOGROS2_FRESH_KUBERNETES') else None


def copy_results(project: Path, target: Path) -> None:
    """Copy the tests' reports and the logs of the set-up."""
    target.mkdir(parents=True, exist_ok=True)
    for pattern in ('*.xml', '*.log'):
        for path in (project / '.cache').glob(pattern):
            shutil.copy(path, target)


def interrupt(number: int, frame: Any) -> None:
    """End in order at the first signal; the next ones would cut that short."""
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)
    sys.exit(128 + number)


def main() -> int:
    """Run the command of the command line and return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--suite', choices=SUITES, default='bookworm')
    parser.add_argument('--password', action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument('--repository', type=Path, default=ROOT)
    parser.add_argument('--commit', default='HEAD')
    parser.add_argument('--results', type=Path,
                        help="folder for a copy of the project's .cache/*.xml and *.log")
    parser.add_argument('command', nargs='+')
    options = parser.parse_args()
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, interrupt)
    try:
        with clean_system(FOLDER, SUITES[options.suite], options.repository, options.commit,
                          password=options.password, kubernetes=KUBERNETES) as system:
            line = options.command[0] if len(options.command) == 1 else shlex.join(options.command)
            try:
                return system.type(line, [sys.stdout], password=options.password)
            finally:
                if options.results is not None:
                    copy_results(system.project, options.results)
    except CleanSystemError as error:
        print(f'** {error}', file=sys.stderr)
        return 1


if __name__ == '__main__':
    sys.exit(main())
