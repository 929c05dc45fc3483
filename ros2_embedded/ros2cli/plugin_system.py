# SPDX-License-Identifier: Apache-2.0
"""Instances of what entry points load."""
from __future__ import annotations

import logging
import re
from typing import Any, Iterable

from ros2cli.entry_points import load_entry_points

PLUGIN_SYSTEM_VERSION = '0.1'

logger = logging.getLogger(__name__)


class PluginException(Exception):
    """An extension doesn't fit its extension point."""


def instantiate_extensions(
    group_name: str, *, exclude_names: Iterable[str] | None = None
) -> dict[str, Any]:
    """Return, by name, an instance of each class of the group; one that fails is logged."""
    instances = {}
    for name, cls in load_entry_points(group_name, exclude_names=exclude_names).items():
        try:
            instance = cls()
        except Exception as exc:  # noqa: BLE001 - Another's code must not end this command.
            logger.warning(f"Failed to instantiate '{group_name}' extension '{name}': {exc}")
            continue
        instance.NAME = name
        instances[name] = instance
    return instances


def _version(text: str) -> tuple[int, ...]:
    numbers = [int(number) for number in re.findall(r'\d+', text)]
    return (*numbers, 0, 0, 0)[:3]


def satisfies_version(version: str, caret_range: str) -> None:
    """
    Refuse an extension point whose version isn't in the range.

    :param caret_range: such as '^1.2': from 1.2 to below 2.0, or '^0.1': 0.1 to below 0.2.
    :raises PluginException: saying which of the two is older.
    """
    assert caret_range.startswith('^'), 'Only supports caret ranges'
    wanted = caret_range[1:]
    point, extension = _version(version), _version(wanted)
    if point < extension:
        raise PluginException(
            f"Extension point is too old ({version}), the extension requires '{wanted}'")
    major, minor, _ = extension
    if point >= ((major + 1, 0, 0) if major else (0, minor + 1, 0)):
        raise PluginException(f'Extension point is newer ({version}), than what the extension '
                              f"supports '{wanted}'")


class Extension:
    """What commands and verbs have alike."""

    NAME: str | None = None
    EXTENSION_POINT_VERSION = '0.1'
