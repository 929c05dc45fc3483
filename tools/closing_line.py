# SPDX-License-Identifier: Apache-2.0
"""
Print 'N passed, N failed, N skipped' over the JUnit files named on the command line.

What failed is named, so that the end of a long output tells it. Beside ``NAME.xml`` there may be
``again-NAME.xml``, a second run of what failed in the first: its results count, and the tests that
passed only then are named too.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import re
import sys
from typing import NamedTuple
import xml.etree.ElementTree as ElementTree


class Report(NamedTuple):
    """The names of tests by what became of them; of those skipped, by the reason."""

    passed: list[str]
    failed: list[str]
    skipped: dict[str, list[str]]
    passed_again: list[str]

    @property
    def counts(self) -> tuple[int, int, int]:
        """How many passed, failed (errors too) and were skipped."""
        return len(self.passed), len(self.failed), sum(map(len, self.skipped.values()))


def _results(path: Path) -> dict[str, str]:
    """Return the result of each test of a JUnit file: passed, failed, or why it was skipped."""
    results: dict[str, str] = {}
    for case in ElementTree.parse(path).getroot().iter('testcase'):
        # pytest-xdist adds the group of the test
        test = re.sub(r'@[^]@]*$', '', case.get('name', ''))
        name = f'{case.get("classname")}::{test}'
        if case.find('failure') is not None or case.find('error') is not None:
            results[name] = 'failed'
        elif (skip := case.find('skipped')) is not None:
            results[name] = f'skipped: {skip.get("message", "")}'
        else:  # an error of a fixture has an entry of its own
            results.setdefault(name, 'passed')
    return results


def read(paths: Iterable[Path]) -> Report:
    """Return what JUnit files tell together."""
    report = Report([], [], {}, [])
    for path in paths:
        again = path.with_name(f'again-{path.name}')
        first, second = _results(path), _results(again) if again.exists() else {}
        report.passed_again.extend(name for name, result in second.items() if (
            first.get(name), result) == ('failed', 'passed'))
        for name, result in {**first, **second}.items():
            if result.startswith('skipped: '):
                report.skipped.setdefault(result.partition(' ')[2], []).append(name)
            else:
                (report.passed if result == 'passed' else report.failed).append(name)
    return report


def main() -> int:
    """Print the lines; the exit status is 1 if a test failed or none ran."""
    try:
        report = read(map(Path, sys.argv[1:]))
    except (OSError, ElementTree.ParseError) as error:
        print(f'the tests left no result: {error}', file=sys.stderr)
        return 1
    for name in report.passed_again:
        print(f'passed only when run again: {name}')
    for name in report.failed:
        print(f'failed: {name}')
    print('{} passed, {} failed, {} skipped'.format(*report.counts))
    return 1 if report.failed or not report.passed else 0


if __name__ == '__main__':
    sys.exit(main())
