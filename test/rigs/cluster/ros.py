# SPDX-License-Identifier: Apache-2.0
"""
This computer's ROS 2 for a machine image, as the pods of a robot that runs ROS 2 need it.

An image is Debian of this computer's own release, so what was built from source here runs there:
its folder is copied, with the libraries that a small system lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
import re
import shutil
from typing import Optional

from fogros2 import process
from fogros2.host import inspection as host
from fogros2.model import Command

#: Where an image of ROS has it.
USUAL = Path('/opt/ros', host.DISTRO)
#: Of them, what a node in Python takes.
_BINARIES = ('lib/librcl*.so', 'lib/librmw*.so', 'lib/python3*/site-packages/rclpy/*.so')
#: Headers are a third of it.
_LEFT_OUT = ('include',)


def prefix(environment: Mapping[str, str] = os.environ) -> Optional[Path]:
    """Return the folder of the ROS 2 that an environment has, None if it has none."""
    for each in environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        folder = Path(each)
        if each and (folder / 'share/ament_index/resource_index/rmw_typesupport' /
                     'rmw_cyclonedds_cpp').exists():
            return folder.resolve()
    return None


def key(folder: Path) -> str:
    """Return what changes when something is installed there."""
    parts = [folder / name for name in ('', 'lib', 'share', 'local_setup.sh')]
    return ' '.join(str(part.stat().st_mtime_ns) for part in parts if part.exists())


def add(folder: Path, root: Path, files: Path) -> None:
    """
    Copy ROS 2 for an image.

    :param folder: this computer's.
    :param root: the system of the image.
    :param files: gets what the image has besides.
    """
    target = files / folder.relative_to('/')
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(folder, target, symlinks=True, ignore=lambda at, names: [
        name for name in names if at == str(folder) and name in _LEFT_OUT])
    usual = files / USUAL.relative_to('/')
    if not usual.exists():
        usual.parent.mkdir(parents=True, exist_ok=True)
        usual.symlink_to(folder)
    for library in _libraries(folder):
        inside = library.parent.resolve().relative_to('/') / library.name
        if not (root / inside).exists():
            (files / inside).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(library, files / inside)
    modules = files / 'usr/lib/python3/dist-packages/ros2.pth'
    modules.parent.mkdir(parents=True, exist_ok=True)
    modules.write_text('\n'.join(_module_folders(folder)) + '\n')


def _libraries(folder: Path) -> list[Path]:
    """Return the shared libraries outside of it that its own need."""
    words = [str(path) for pattern in _BINARIES for path in sorted(folder.glob(pattern))]
    told = process.run(Command(
        ('ldd', *words), environment={'LD_LIBRARY_PATH': str(folder / 'lib')},
        what="look at ROS 2's libraries"), timeout=60.0, check=False).stdout
    found = {Path(path) for path in re.findall(r'=> (/\S+) \(', told)}
    return sorted(path for path in found if folder not in path.resolve().parents)


def _module_folders(folder: Path) -> list[str]:
    """Return where its interpreter, if it has one of its own, finds what apt brings elsewhere."""
    first = (folder / 'bin/ros2').read_text(errors='replace').partition('\n')[0]
    python = first.removeprefix('#!').split()[0]
    told = process.run(Command(
        (python, '-Ic', 'import sys; print(*sys.path, sep="\\n")'),
        what="look at ROS 2's interpreter"), timeout=30.0).stdout
    return [line for line in told.splitlines() if folder in Path(line).parents]
