# SPDX-License-Identifier: Apache-2.0
"""Packages' executables."""
from __future__ import annotations

import os

from ament_index_python.packages import get_package_prefix, PackageNotFoundError


def get_prefix_path(package_name: str) -> str | None:
    """Return where the package is installed, None if it isn't."""
    try:
        prefix: str = get_package_prefix(package_name)
    except (PackageNotFoundError, ValueError):
        return None
    return prefix


def get_executable_paths(package_name: str) -> list[str]:
    """
    Return the paths of the package's executables.

    :raises RuntimeError: if there is no such package.
    """
    prefix = get_prefix_path(package_name)
    if prefix is None:
        raise RuntimeError(f"Package '{package_name}' not found")
    paths = []
    for directory, directories, files in os.walk(os.path.join(prefix, 'lib', package_name)):
        directories[:] = sorted(name for name in directories if not name.startswith('.'))
        paths += [
            path for name in sorted(files)
            if os.access(path := os.path.join(directory, name), os.X_OK)]
    return paths
