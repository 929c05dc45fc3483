# SPDX-License-Identifier: Apache-2.0
"""Extensions of launch_ros, by entry points."""
from __future__ import annotations

import logging
from typing import Any, Dict

from ros2cli.entry_points import load_entry_points
from ros2cli.plugin_system import PluginException, satisfies_version

__all__ = ['get_extensions', 'PluginException', 'satisfies_version']

_types: Dict[str, Dict[str, Any]] = {}


def get_extensions(group_name: str, logger: logging.Logger) -> Dict[str, Any]:
    """Return new instances of the group's extensions; one that fails is logged and left out."""
    if group_name not in _types:
        _types[group_name] = load_entry_points(group_name)
    extensions = {}
    for name, extension_class in _types[group_name].items():
        try:
            extension = extension_class()
        except Exception as exc:  # noqa: BLE001 - Another's code must not end this launch.
            logger.error(f"Failed to instantiate '{group_name}' extension '{name}': {exc}")
            continue
        extension.NAME = name
        extensions[name] = extension
    return extensions
