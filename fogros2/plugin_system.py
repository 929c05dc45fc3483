# SPDX-License-Identifier: Apache-2.0
"""Load plugins: entry points, found by group and name, imported on first use."""

from __future__ import annotations

import functools
from typing import Any, TYPE_CHECKING

from fogros2.errors import ConfigurationError, did_you_mean, FogError, PrerequisiteError
from fogros2.untrusted import clean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

#: What messages call the plugins of a group whose name does not end so.
_KINDS = {'fogros2.machine': 'provider', 'fogros2.market': 'feature', 'fogros2.vpn': 'VPN',
          'fogros2.dds': 'DDS vendor'}


@functools.lru_cache(maxsize=1)
def _all() -> Any:
    # The files of all installed packages are read once: 15 ms.
    # Imported on first use: `from fogros2 import CloudNode` would take 10% longer.
    from importlib import metadata

    return metadata.entry_points()


@functools.cache
def _entry_points(group: str) -> dict[str, EntryPoint]:
    # of several packages with one name, the first on sys.path has it, as for modules
    return {point.name: point for point in reversed(list(_all().select(group=group)))}


@functools.cache
def own_packages() -> tuple[str, ...]:
    """Return all packages of FogROS2; an index may have unrelated projects of these names."""
    from importlib import metadata

    return tuple((metadata.distribution('fogros2').read_text('top_level.txt') or '').split())


def names(group: str) -> list[str]:
    """Return the sorted names of a group's plugins without importing them."""
    return sorted(_entry_points(group))


def load(group: str, name: str) -> Any:
    """
    Import the object of the entry point ``name`` in ``group``, and return it.

    :raises ConfigurationError: no such plugin; the hint names the nearest.
    :raises PrerequisiteError: a dependency of the plugin is not installed, or its module fails.
    """
    points = _entry_points(group)
    if name not in points:
        raise ConfigurationError(f"there is no {_kind(group)} '{name}'",
                                 did_you_mean(name, sorted(points)))
    try:
        return points[name].load()
    except ImportError as error:
        module = error.name or name
        dist = str(getattr(points[name].dist, 'name', 'fogros2'))
        own = dist == 'fogros2'
        # a module of an unknown package may have another name than its project
        remedy = f'python3 -m pip install {module if own else f"--upgrade {dist}"}'
        if module.partition('.')[0] in own_packages():
            remedy = ('install FogROS2 again from the folder that it came from; in a workspace, '
                      'delete build/fogros2 and install/fogros2 before') if own else \
                f'install a version of {dist} that is for this version of FogROS2'
        raise PrerequisiteError(
            f"the {_kind(group)} '{name}' can't be loaded: {error}", remedy) from error
    except Exception as error:  # one defective plugin must not end the others
        point = points[name]
        version = f'{point.dist.name} {point.dist.version}' if point.dist else point.value
        raise PrerequisiteError(
            f"the {_kind(group)} '{name}' of {version} can't be loaded: {cause(error)}",
            f"python3 -c 'import {point.module}' shows where") from error


def cause(error: Exception) -> str:
    """Return a line about an error of a plugin: for an unexpected one with its kind."""
    return str(error) if isinstance(error, FogError) else clean(f'{type(error).__name__}: {error}')


def _kind(group: str) -> str:
    return _KINDS.get(group, group.rpartition('.')[2].replace('_', ' '))
