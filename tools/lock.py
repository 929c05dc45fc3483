# SPDX-License-Identifier: Apache-2.0
"""
Write fogros2/locked.txt: what a machine may take from its package index, pinned with hashes.

    tools/run.sh embedded -- python tools/lock.py

It takes ``uv`` (``pip install uv``), which asks the index that it is set up with. A version is
chosen for each Python that we support, and all its wheels are taken, whatever their processor.
"""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys
import tempfile

from fogros2 import locked
from fogros2.modules import MODULES

#: What the embedded default needs and a robot can't send to another kind of machine: see
#: ros2_embedded/setup.py. The pure Python distributions travel.
EMBEDDED = ('cyclonedds>=11.0,<12', 'numpy', 'PyYAML')
#: That of the sources: the installed package has a copy.
TARGET = Path(__file__).resolve().parents[1] / 'fogros2' / locked.FILE.name
#: The oldest Python of a machine.
PYTHON = '3.10'
HEADER = """\
# Written by tools/lock.py. pip takes these wheels on a machine that the robot's own do not fit.
"""


def resolved(requirements: list[str]) -> str:
    """Return requirements and what they need, pinned with the hashes of all files."""
    with tempfile.NamedTemporaryFile('w', suffix='.in') as file:
        file.write('\n'.join(requirements) + '\n')
        file.flush()
        return subprocess.run(
            ['uv', 'pip', 'compile', '--quiet', '--universal', '--python-version', PYTHON,
             '--only-binary', ':all:', '--generate-hashes', '--no-header', '--no-annotate',
             file.name], check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Resolve all together, as they are used together, and keep those that are asked for."""
    requirements = list(dict.fromkeys(
        [*EMBEDDED, *(module.requirement for module in MODULES.values())]))
    entries = locked.parse(resolved(requirements))
    names = sorted({locked.name_of(requirement) for requirement in requirements})
    missing = [name for name in names if name not in entries]
    if missing:
        sys.exit(f'uv has no answer for {", ".join(missing)}')
    TARGET.write_text(HEADER + ''.join(
        entry.replace(' --hash', ' \\\n    --hash') + '\n'
        for name in names for entry in entries[name]))
    print(f'{TARGET}: {", ".join(names)}')


if __name__ == '__main__':
    main()
