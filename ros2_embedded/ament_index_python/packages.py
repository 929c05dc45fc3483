# SPDX-License-Identifier: Apache-2.0
"""Packages and their folders."""

import os
import pathlib
import re
import warnings

from ament_index_python.resources import get_resource, get_resources
from ament_index_python.search_paths import get_search_paths

__all__ = [
    'get_package_prefix', 'get_package_share_directory', 'get_package_share_path',
    'get_packages_with_prefixes', 'PackageNotFoundError']


class PackageNotFoundError(KeyError):
    """There is no such package."""


def get_packages_with_prefixes() -> dict[str, str]:
    """Give the prefixes of all packages, by their names."""
    return get_resources('packages')


def get_package_prefix(package_name: str) -> str:
    """
    Give the prefix a package is installed in.

    :raises PackageNotFoundError: if there is none of that name.
    :raises ValueError: if that is no package's name (REP 127).
    """
    if re.fullmatch('[a-zA-Z0-9][a-zA-Z0-9_-]+', package_name, re.ASCII) is None:
        raise ValueError(f"'{package_name}' is not a valid package name")
    try:
        return get_resource('packages', package_name)[1]
    except LookupError:
        raise PackageNotFoundError(
            f"package '{package_name}' not found, searching: {get_search_paths()}") from None


def get_package_share_directory(package_name: str, print_warning: bool = True) -> str:
    """
    Give a package's share folder.

    :param print_warning: warn if there is no such folder.
    :raises PackageNotFoundError: if there is no such package.
    """
    path = os.path.join(get_package_prefix(package_name), 'share', package_name)
    if print_warning and not os.path.exists(path):
        warnings.warn(f'Share directory for {package_name} ({path}) does not exist.', stacklevel=2)
    return path


def get_package_share_path(package_name: str, print_warning: bool = True) -> pathlib.Path:
    """Give a package's share folder; see :func:`get_package_share_directory`."""
    path = pathlib.Path(get_package_share_directory(package_name, print_warning=False))
    if print_warning and not path.exists():
        warnings.warn(f'Share path for {package_name} ({path}) does not exist.', stacklevel=2)
    return path
