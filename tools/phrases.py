# SPDX-License-Identifier: Apache-2.0
"""
Refuse phrases that are hard to read in code, messages and pages, and long names of tests.

    python tools/phrases.py [FOLDER]

Prints file, line and phrase or name of each, and returns 1 if there is one. FOLDER is the
project's.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import re
import sys

ROOT = Path(__file__).resolve().parents[1]
PHRASES = (
    'take it that', 'is told', 'are told', 'be told', 'told of', 'told beside', 'whoever',
    'no more at all', 'by the word of', 'as it is there', 'what is asked of', 'is called so',
)
#: Characters that the name of a test may have; it states one behaviour.
LONGEST_NAME = 60
TEST = re.compile(rf'^ *(?:async )?def (test_\w{{{LONGEST_NAME - 4},}})', re.MULTILINE)
#: Folders that builds or measurements write.
WRITTEN = ('build', 'install', 'log', 'benchmarks/results')
#: Between two words: space, also with the beginning of the next comment, or the end of a string
#: literal with the beginning of the next one.
BETWEEN = r'''(?:\s|\n\s*(?:\#:?|//|\*)|['"]\s*[fr]*['"])+'''
PATTERN = re.compile('|'.join(
    rf'\b{BETWEEN.join(map(re.escape, phrase.split()))}\b' for phrase in PHRASES), re.IGNORECASE)


def texts(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield name and content of each text file of the project, except this one."""
    for place, folders, files in os.walk(folder):
        here = Path(place)
        folders[:] = sorted(
            name for name in folders if not name.startswith('.') and name != '__pycache__'
            and (here / name).relative_to(folder).as_posix() not in WRITTEN)
        for path in sorted(here / name for name in files):
            if path.resolve() != Path(__file__).resolve():
                with contextlib.suppress(UnicodeDecodeError, FileNotFoundError):
                    yield path.relative_to(folder).as_posix(), path.read_text()


def found(folder: Path) -> Iterator[str]:
    """Yield a line for each phrase, and for each long name of a test, in the project's files."""
    for name, text in texts(folder):
        for match in PATTERN.finditer(text):
            line = text.count('\n', 0, match.start()) + 1
            yield f'{name}:{line}: {" ".join(match[0].split())!r} is hard to read: rewrite it'
        for match in TEST.finditer(text) if name.endswith('.py') else ():
            line = text.count('\n', 0, match.start()) + 1
            yield f'{name}:{line}: {match[1]} has more than {LONGEST_NAME} characters'


def main(folder: Path) -> int:
    """Print all phrases; return 1 if there is one."""
    lines = list(found(folder))
    print('\n'.join(lines), end='\n' if lines else '')
    return 1 if lines else 0


if __name__ == '__main__':
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT))
