# SPDX-License-Identifier: Apache-2.0
"""
Make the ROS 2 wheels of the package index load their libraries by themselves.

The wheels put libraries into ``PREFIX/lib``, where the dynamic linker does not search, and into
folders ``ros_*.libs`` beside the modules. Their own remedy starts each Python of the environment a
second time with another LD_LIBRARY_PATH, which every program inherits that a node starts. Their
DT_RPATH names folders outside the environment, which may belong to another account.

This program replaces both by a DT_RUNPATH relative to each library. It runs once, after the
installation, by the interpreter of the environment, and needs the program ``patchelf`` there:

    PREFIX/bin/python -I relocation.py

It uses the standard library only: it runs before anything of ours is installed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import csv
import os
from pathlib import Path
import subprocess
import sys
import sysconfig

#: Makes every Python of the environment find its packages in the ament index, and marks the
#: environment as done.
MARK = 'ros_prefix.pth'
_LINE = (
    "import os, sys; os.environ['AMENT_PREFIX_PATH'] = os.pathsep.join(dict.fromkeys([*filter("
    "None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)), sys.prefix]))\n")
_BOOTSTRAPPER = 'ros_wheels_bootstrapper.pth'


def libraries(site: Path) -> list[Path]:
    """Return the ELF files of the ROS distributions in a site-packages folder, sorted."""
    found = set()
    for record in site.glob('ros_*.dist-info/RECORD'):
        with record.open(newline='') as lines:
            found |= {Path(os.path.normpath(site / row[0])) for row in csv.reader(lines) if row}
    return sorted(path for path in found if '.so' in path.name and path.is_file()
                  and not path.is_symlink() and path.open('rb').read(4) == b'\x7fELF')


def relocate(prefix: Path, site: Path, patchelf: str) -> int:
    """
    Give the ROS libraries of an environment their search path; do nothing the second time.

    A library that several distributions bring is kept once: the names contain a hash of the
    content.

    :param site: its site-packages folder.
    :param patchelf: path of the program.
    :returns: number of changed libraries.
    :raises subprocess.CalledProcessError: patchelf refused a library.
    """
    if (site / MARK).exists():
        return 0
    (site / _BOOTSTRAPPER).unlink(missing_ok=True)
    kept: dict[str, Path] = {}
    for path in libraries(site):
        if path.parent.name.endswith('.libs') and path.name in kept:
            path.unlink()
        elif path.parent.name.endswith('.libs'):
            kept[path.name] = path
    places = [prefix / 'lib', *sorted({path.parent for path in kept.values()})]

    def change(path: Path) -> None:
        names = (os.path.relpath(place, path.parent) for place in places)
        runpath = ':'.join(f'$ORIGIN/{name}' if name != '.' else '$ORIGIN' for name in names)
        subprocess.run([patchelf, '--set-rpath', runpath, str(path)], check=True)

    found = libraries(site)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(change, found))
    (site / MARK).write_text(_LINE)
    return len(found)


if __name__ == '__main__':
    relocate(Path(sys.prefix), Path(sysconfig.get_path('platlib')), f'{sys.prefix}/bin/patchelf')
