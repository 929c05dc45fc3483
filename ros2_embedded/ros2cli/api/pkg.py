# SPDX-License-Identifier: Apache-2.0
"""Packages and their executables."""
from __future__ import annotations

import os
from typing import Any, Iterable, List, Optional

from ament_index_python.packages import (
    get_package_prefix,
    get_packages_with_prefixes,
    PackageNotFoundError,
)


class PackageNotFound(Exception):
    """There is no such package."""

    def __init__(self, package_name: str) -> None:
        super().__init__(package_name)
        self.package_name = package_name


class MultipleExecutables(Exception):
    """More than one executable has the name."""

    def __init__(self, paths: Iterable[str]) -> None:
        self.paths = list(paths)
        super().__init__(', '.join(self.paths))


def get_package_names() -> Iterable[str]:
    """Return the names of all packages."""
    names: Iterable[str] = get_packages_with_prefixes().keys()
    return names


def get_prefix_path(package_name: str) -> Optional[str]:
    """Return where the package is installed, None if it isn't."""
    try:
        return str(get_package_prefix(package_name))
    except (PackageNotFoundError, ValueError):
        return None


def get_executable_paths(*, package_name: str) -> List[str]:
    """
    Return the paths of the package's executables.

    :raises PackageNotFound: if there is no such package.
    """
    prefix = get_prefix_path(package_name)
    if prefix is None:
        raise PackageNotFound(package_name)
    paths = []
    for directory, directories, files in os.walk(os.path.join(prefix, 'lib', package_name)):
        directories[:] = sorted(name for name in directories if not name.startswith('.'))
        paths += [
            path for name in sorted(files)
            if os.access(path := os.path.join(directory, name), os.X_OK)]
    return paths


def get_executable_path(*, package_name: str, executable_name: str) -> Optional[str]:
    """
    Return the path of the package's executable, None if there is none of that name.

    :raises PackageNotFound: if there is no such package.
    :raises MultipleExecutables: if there are several.
    """
    paths = [path for path in get_executable_paths(package_name=package_name)
             if os.path.basename(path) == executable_name]
    if len(paths) > 1:
        raise MultipleExecutables(paths)
    return paths[0] if paths else None


def package_name_completer(**kwargs: Any) -> Iterable[str]:
    """Return the names of all packages, for argcomplete."""
    return get_package_names()


class ExecutableNameCompleter:
    """The names of a package's executables, for argcomplete."""

    def __init__(self, *, package_name_key: str) -> None:
        self.package_name_key = package_name_key

    def __call__(self, prefix: str, parsed_args: Any, **kwargs: Any) -> List[str]:
        package = getattr(parsed_args, self.package_name_key)
        try:
            paths = get_executable_paths(package_name=package)
        except PackageNotFound:
            return []
        return [os.path.basename(path) for path in paths]
