# SPDX-License-Identifier: Apache-2.0
"""Print 'N passed, N failed, N skipped' over the JUnit files named on the command line."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree


def counts(path: str) -> tuple[int, int, int]:
    """Return how many tests of a JUnit file passed, failed (errors too) and were skipped."""
    total = failed = skipped = 0
    for suite in ElementTree.parse(path).getroot().iter('testsuite'):
        total += int(suite.get('tests', 0))
        failed += int(suite.get('failures', 0)) + int(suite.get('errors', 0))
        skipped += int(suite.get('skipped', 0))
    return total - failed - skipped, failed, skipped


def main() -> int:
    """Print the line; the exit status is 1 if a test failed or none ran."""
    try:
        passed, failed, skipped = (sum(c) for c in zip(*map(counts, sys.argv[1:])))
    except (OSError, ElementTree.ParseError) as error:
        print(f'the tests left no result: {error}', file=sys.stderr)
        return 1
    print(f'{passed} passed, {failed} failed, {skipped} skipped')
    return 1 if failed or not passed else 0


if __name__ == '__main__':
    sys.exit(main())
