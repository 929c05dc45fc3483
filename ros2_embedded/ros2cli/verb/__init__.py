# SPDX-License-Identifier: Apache-2.0
"""Verbs of commands."""
from __future__ import annotations

from ros2cli.plugin_system import Extension


class VerbExtension(Extension):
    """A verb; its ``main(*, args)`` returns the exit status, or a text for standard error."""
