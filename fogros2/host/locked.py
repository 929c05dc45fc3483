# SPDX-License-Identifier: Apache-2.0
"""
Pinned versions, with hashes, of the distributions that a machine may get from its package index.

Compiled wheels of the robot do not run with another processor, C library or Python. A machine
gets them from its own index, and pip refuses files with other hashes. ``tools/lock.py`` writes
the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import re
from typing import Optional

from fogros2.errors import PrerequisiteError

FILE = Path(__file__).with_name('locked.txt')
#: Start of the names of ROS 2's distributions.
ROS = 'ros-'
#: Options of pip besides the requirements. Sources would be built by programs without hashes.
OPTIONS = ('--no-deps', '--require-hashes', '--only-binary', ':all:')


def name_of(requirement: str) -> str:
    """Return the normalised name in a requirement: ``pyyaml`` for ``PyYAML>=6``."""
    return re.sub('[-_.]+', '-', re.split(r'[^A-Za-z0-9._-]', requirement.strip())[0]).lower()


def parse(text: str) -> dict[str, list[str]]:
    """
    Return the entries of a requirements file by the distribution's name.

    A distribution has several entries if the version depends on the Python.
    """
    entries: dict[str, list[str]] = {}
    for entry in re.sub(r'\s*\\\n\s*', ' ', text).splitlines():
        if entry.strip() and not entry.startswith('#'):
            entries.setdefault(name_of(entry), []).append(entry.strip())
    return entries


def requirements(
    names: Iterable[str], python: Optional[tuple[int, int]] = None,
) -> list[str]:
    """
    Return the lines of a requirements file for some distributions.

    :param python: version of the interpreter that they are for; by default each version's.
    :raises PrerequisiteError: a distribution is not pinned.
    """
    entries = parse(FILE.read_text())
    lines: list[str] = []
    for name in names:
        if name_of(name) not in entries:
            raise PrerequisiteError(
                f'{name} is compiled for this robot, and no other build of it is pinned',
                'choose a machine with the same Python, processor and C library as the robot')
        matches = entries[name_of(name)]
        lines += matches if python is None else filter(
            None, (_for_python(line, python) for line in matches))
    return lines


def _for_python(line: str, python: tuple[int, int]) -> str:
    """Return an entry without its marker, '' if the marker excludes a version of Python."""
    from packaging.markers import Marker
    requirement, _, options = line.partition(' --hash')
    name, _, marker = requirement.partition(' ; ')
    if marker and not Marker(marker).evaluate(
            {'python_full_version': '{}.{}.0'.format(*python)}):
        return ''
    return f'{name} --hash{options}'


def ros() -> list[str]:
    """Return the names of the distributions of ROS 2 that nodes need."""
    return [name for name in parse(FILE.read_text()) if name.startswith(ROS)]


def from_file(path: str, sha256: str, name: str) -> str:
    """Return the line of a requirements file for a wheel on the disk, with its hash."""
    from urllib.parse import quote
    return f'{name} @ file://{quote(path)} --hash=sha256:{sha256}'
