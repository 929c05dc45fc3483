# SPDX-License-Identifier: Apache-2.0
"""Instances of what entry points load."""
from __future__ import annotations

from collections import OrderedDict
import logging
import re
from typing import Any, Callable, Dict, Iterable, Optional, Tuple

from ros2cli.entry_points import load_entry_points

PLUGIN_SYSTEM_VERSION = '0.1'

logger = logging.getLogger(__name__)

_extension_instances: Dict[Any, Any] = {}


class PluginException(Exception):
    """An extension doesn't fit its extension point."""


def instantiate_extensions(
    group_name: str, *, exclude_names: Optional[Iterable[str]] = None,
    unique_instance: bool = False
) -> Dict[str, Any]:
    """
    Return an instance of each of the group's classes; one that fails is logged and left out.

    :param unique_instance: whether to make new ones even if there are some.
    """
    instances = {}
    for name, extension_class in load_entry_points(
            group_name, exclude_names=exclude_names).items():
        instance = None if unique_instance else _extension_instances.get(extension_class)
        if instance is None:
            try:
                instance = extension_class()
            except PluginException as exc:
                logger.warning(f"Failed to instantiate '{group_name}' extension '{name}': {exc}")
                continue
            except Exception as exc:  # noqa: BLE001 - Another's code must not end this command.
                logger.error(f"Failed to instantiate '{group_name}' extension '{name}': {exc}")
                continue
            if not unique_instance:
                _extension_instances[extension_class] = instance
        instances[name] = instance
    return instances


def order_extensions(
    extensions: Dict[str, Any], key_function: Callable[[Tuple[str, Any]], Any], *,
    reverse: bool = False
) -> 'OrderedDict[str, Any]':
    """Return the extensions, ordered."""
    return OrderedDict(sorted(extensions.items(), key=key_function, reverse=reverse))


def order_extensions_by_name(extensions: Dict[str, Any]) -> 'OrderedDict[str, Any]':
    """Return the extensions, ordered by name."""
    return order_extensions(extensions, lambda pair: pair[0])


def _version(text: str) -> Tuple[int, int, int]:
    numbers = [int(number) for number in re.findall(r'\d+', text)[:3]]
    major, minor, patch = (*numbers, 0, 0, 0)[:3]
    return major, minor, patch


def satisfies_version(version: str, caret_range: str) -> None:
    """
    Refuse an extension point whose version isn't in the range.

    :param caret_range: such as '^1.2': from 1.2 to below 2.0, or '^0.1': 0.1 to below 0.2.
    :raises PluginException: saying which of the two is older.
    """
    assert caret_range.startswith('^'), 'Only supports caret ranges'
    point, extension = _version(version), _version(caret_range[1:])
    major, minor, _ = extension
    if point < extension:
        raise PluginException(
            f"Extension point is too old ({version}), the extension requires "
            f"'{caret_range[1:]}'")
    if point >= ((major + 1, 0, 0) if major else (0, minor + 1, 0)):
        raise PluginException(
            f'Extension point is newer ({version}), than what the extension supports '
            f"'{caret_range[1:]}'")
