# SPDX-License-Identifier: Apache-2.0
"""Plugins: entry points looked up by group and name, imported when first asked for."""

from __future__ import annotations

import functools
from typing import Any, TYPE_CHECKING

from fogros2.errors import ConfigurationError, did_you_mean, PrerequisiteError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

#: What a group's plugins are called in messages.
GROUPS = {
    'fogros2.provider': 'provider',
    'fogros2.machine': 'provider',
    'fogros2.shell': 'shell',
    'fogros2.vpn': 'VPN',
    'fogros2.dds': 'DDS vendor',
    'fogros2.image_transport': 'image transport',
    'fogros2.monitor': 'monitor',
}
#: All packages that setup.py installs: a package index may have other projects of these names.
OWN_PACKAGES = (
    'fogros2', 'fogros2_examples', 'fogros2_monitor', 'image_transport_h264', 'ros2fog_cli')


@functools.lru_cache(maxsize=None)
def _entry_points(group: str) -> dict[str, EntryPoint]:
    # A tenth of the time that `from fogros2 import CloudNode` may take, so not before it's asked.
    from importlib import metadata

    return {point.name: point for point in metadata.entry_points(group=group)}


def names(group: str) -> list[str]:
    """Return the names of the plugins of a group, sorted; imports none of them."""
    return sorted(_entry_points(group))


def load(group: str, name: str) -> Any:
    """
    Import and return the object that the entry point ``name`` of ``group`` names.

    :raises ConfigurationError: no such plugin; the hint holds the nearest names.
    :raises PrerequisiteError: the plugin's own dependency isn't installed.
    """
    points = _entry_points(group)
    if name not in points:
        raise ConfigurationError(f"no {GROUPS.get(group, group)} is called '{name}'",
                                 did_you_mean(name, sorted(points)))
    try:
        return points[name].load()
    except ImportError as error:
        module = error.name or name
        ours = module.partition('.')[0] in OWN_PACKAGES
        raise PrerequisiteError(
            f"the {GROUPS.get(group, group)} '{name}' can't be loaded: {error}",
            'install FogROS2 again from the folder that it came from' if ours else
            f'python3 -m pip install {module}') from error
