# SPDX-License-Identifier: Apache-2.0
"""Verbs of commands."""
from __future__ import annotations

from typing import Any, Dict, Optional

from ros2cli.plugin_system import instantiate_extensions, PLUGIN_SYSTEM_VERSION, satisfies_version


class VerbExtension:
    """
    A verb; its ``main(*, args)`` returns the exit status, or a text for standard error.

    :raises PluginException: if the extension is for another version.
    """

    NAME: Optional[str] = None
    EXTENSION_POINT_VERSION = '0.1'

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, '^0.1')


def get_verb_extensions(name: str) -> Dict[str, Any]:
    """Return the group's verbs by name."""
    extensions = instantiate_extensions(name)
    for key, extension in extensions.items():
        extension.NAME = key
    return extensions
