# SPDX-License-Identifier: Apache-2.0
"""A colcon workspace as ``colcon build`` leaves it, made without colcon."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
import sys


def colcon_workspace(
    root: Path, package: str, *, programs: Mapping[str, str], module: str = '',
) -> dict[str, str]:
    """
    Lay a Python package out in ``src`` and in an isolated install space.

    There are also ``build`` and ``.git``, which no machine needs, and ``share/PACKAGE/large``.

    :param programs: executables of the package and their Python sources.
    :param module: source of the module ``PACKAGE.text``.
    :returns: the variables that the workspace's set-up script would set.
    """
    prefix = root / 'install' / package
    version = f'python{sys.version_info.major}.{sys.version_info.minor}'
    site = prefix / 'lib' / version / 'site-packages'
    manifest = (f'<package format="3"><name>{package}</name><export>'
                f'<build_type>ament_python</build_type></export></package>\n')
    files = {
        root / 'install' / '.colcon_install_layout': 'isolated\n',
        root / 'install' / 'local_setup.sh': '',
        root / 'src' / package / 'package.xml': manifest,
        root / 'build' / package / 'left.here': 'x' * 100_000,
        root / '.git' / 'HEAD': 'ref: refs/heads/main\n',
        prefix / 'share' / package / 'package.xml': manifest,
        prefix / 'share' / package / 'large': 'y' * 300_000,
        prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / package: '',
        site / package / '__init__.py': '',
        site / package / 'text.py': module,
    }
    for name, text in programs.items():
        files[prefix / 'lib' / package / name] = f'#!/usr/bin/env python3\n{text}'
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for name in programs:
        (prefix / 'lib' / package / name).chmod(0o755)
    paths = {'COLCON_PREFIX_PATH': root / 'install', 'AMENT_PREFIX_PATH': prefix,
             'PYTHONPATH': site}
    return {name: os.pathsep.join(filter(None, (str(path), os.environ.get(name))))
            for name, path in paths.items()}
