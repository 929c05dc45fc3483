# SPDX-License-Identifier: Apache-2.0
"""Entry points of installed distributions."""
from __future__ import annotations

import functools
from importlib import metadata
import logging
from typing import Any, Iterable

logger = logging.getLogger(__name__)


# read once: there are files of each distribution
_all = functools.cache(metadata.entry_points)


def get_entry_points(group_name: str) -> dict[str, metadata.EntryPoint]:
    """Return the group's entry points by name."""
    return {entry_point.name: entry_point for entry_point in _all().select(group=group_name)}


def load_entry_points(
    group_name: str, *, exclude_names: Iterable[str] | None = None
) -> dict[str, Any]:
    """Return what the group's entry points load, by name; one that fails is logged."""
    loaded = {}
    for name, entry_point in get_entry_points(group_name).items():
        if name in (exclude_names or ()):
            continue
        try:
            loaded[name] = entry_point.load()
        except Exception as exc:  # noqa: BLE001 - Another's module must not end this command.
            logger.warning(f"Failed to load entry point '{name}': {exc}")
    return loaded


def get_first_line_doc(any_type: Any) -> str:
    """Return the first line of the docstring, without a dot at its end."""
    lines = (any_type.__doc__ or '').splitlines()
    return next((line.strip().rstrip('.') for line in lines[:2] if line.strip()), '')
