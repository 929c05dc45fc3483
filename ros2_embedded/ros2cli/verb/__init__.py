# SPDX-License-Identifier: Apache-2.0
"""Verbs of commands."""
from __future__ import annotations

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version


class VerbExtension:
    """
    A verb; its ``main(*, args)`` returns the exit status, or a text for standard error.

    :raises PluginException: if the extension is for another version.
    """

    NAME: str | None = None
    EXTENSION_POINT_VERSION = '0.1'

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, '^0.1')
