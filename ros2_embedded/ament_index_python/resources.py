# SPDX-License-Identifier: Apache-2.0
"""Resources: files below a prefix, by type and name."""

import os
from pathlib import Path
from typing import Literal

from ament_index_python.constants import RESOURCE_INDEX_SUBFOLDER
from ament_index_python.search_paths import get_search_paths

__all__ = [
    'get_resource', 'get_resources', 'has_resource', 'InvalidResourceNameError',
    'InvalidResourceTypeNameError']


class InvalidResourceTypeNameError(ValueError):
    """A resource type's name holds a path separator."""


class InvalidResourceNameError(ValueError):
    """A resource's name holds a path separator."""


def _check(resource_type: str, resource_name: str | None = None) -> None:
    assert resource_type, 'The resource type must not be empty'
    if '/' in resource_type or '\\' in resource_type:
        raise InvalidResourceTypeNameError(f"Resource type '{resource_type}' is invalid")
    if resource_name is not None:
        assert resource_name, 'The resource name must not be empty'
        if '/' in resource_name or '\\' in resource_name:
            raise InvalidResourceNameError(f"Resource name '{resource_name}' is invalid")


def get_resource(resource_type: str, resource_name: str) -> tuple[str, str]:
    """
    Read a resource.

    :returns: its content and its prefix.
    :raises LookupError: if there is none of that type and name.
    :raises OSError: if it can't be read.
    """
    prefix = has_resource(resource_type, resource_name)
    if not prefix:
        raise LookupError(
            f"Could not find the resource '{resource_name}' of type '{resource_type}'")
    path = os.path.join(prefix, RESOURCE_INDEX_SUBFOLDER, resource_type, resource_name)
    try:
        with open(path, encoding='utf-8') as file:
            return file.read(), prefix
    except OSError as error:
        raise OSError(f"Could not open the resource '{resource_name}' of type "
                      f"'{resource_type}':\n{error}") from error


def get_resources(resource_type: str) -> dict[str, str]:
    """Give the prefixes of all resources of a type, by their names."""
    _check(resource_type)
    found: dict[str, str] = {}
    for prefix in get_search_paths():
        for path in Path(prefix, RESOURCE_INDEX_SUBFOLDER, resource_type).glob('[!.]*'):
            if path.is_file():
                found.setdefault(path.name, prefix)
    return found


def has_resource(resource_type: str, resource_name: str) -> str | Literal[False]:
    """Give the prefix of a resource; False if there is none."""
    _check(resource_type, resource_name)
    for prefix in get_search_paths():
        if os.path.isfile(os.path.join(
                prefix, RESOURCE_INDEX_SUBFOLDER, resource_type, resource_name)):
            return prefix
    return False
