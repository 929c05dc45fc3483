# SPDX-License-Identifier: Apache-2.0
"""Load plugins: entry points, found by group and name, imported on first use."""

from __future__ import annotations

import functools
from typing import Any, TYPE_CHECKING

from fogros2.errors import ConfigurationError, did_you_mean, PrerequisiteError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

#: What messages call the plugins of a group.
GROUPS = {
    'fogros2.provider': 'provider',
    'fogros2.machine': 'provider',
    'fogros2.shell': 'shell',
    'fogros2.vpn': 'VPN',
    'fogros2.dds': 'DDS vendor',
    'fogros2.feature': 'feature',
    'fogros2.image_transport': 'image transport',
    'fogros2.monitor': 'monitor',
}
#: All packages that setup.py installs; a package index may have unrelated projects of these names.
OWN_PACKAGES = (
    'fogros2', 'fogros2_examples', 'fogros2_features', 'fogros2_monitor', 'fogros2_replicas',
    'fogros2_share', 'image_transport_h264', 'point_cloud_stream', 'ros2fog_cli')


@functools.lru_cache(maxsize=1)
def _all() -> Any:
    # The files of all installed packages are read once: 15 ms.
    # Imported on first use: `from fogros2 import CloudNode` would take 10% longer.
    from importlib import metadata

    return metadata.entry_points()


@functools.cache
def _entry_points(group: str) -> dict[str, EntryPoint]:
    return {point.name: point for point in _all().select(group=group)}


def names(group: str) -> list[str]:
    """Return the sorted names of a group's plugins without importing them."""
    return sorted(_entry_points(group))


def load(group: str, name: str) -> Any:
    """
    Import the object of the entry point ``name`` in ``group``, and return it.

    :raises ConfigurationError: no such plugin; the hint names the nearest.
    :raises PrerequisiteError: a dependency of the plugin is not installed.
    """
    points = _entry_points(group)
    if name not in points:
        raise ConfigurationError(f"there is no {GROUPS.get(group, group)} '{name}'",
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
