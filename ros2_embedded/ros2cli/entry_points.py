# SPDX-License-Identifier: Apache-2.0
"""
Entry points of installed distributions.

Reads the files itself: importing :mod:`importlib.metadata` takes longer than all of this.
"""
from __future__ import annotations

import importlib
import logging
import os
import re
import sys
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Optional, Tuple

logger = logging.getLogger(__name__)


class EntryPoint(NamedTuple):
    """A name for an object in a module."""

    name: str
    group: str
    value: str

    @property
    def module_name(self) -> str:
        """The module."""
        return self.__parts[0]

    @property
    def attrs(self) -> List[str]:
        """The way from the module to the object."""
        return [part for part in self.__parts[1].split('.') if part]

    @property
    def __parts(self) -> Tuple[str, str]:
        module, _, path = self.value.partition('[')[0].partition(':')
        return module.strip(), path.strip()

    def load(self) -> Any:
        """Import the module and return the object; raises what importing it raises."""
        loaded: Any = importlib.import_module(self.module_name)
        for attribute in self.attrs:
            loaded = getattr(loaded, attribute)
        return loaded


def _metadata_files() -> Iterator[str]:
    seen = set()
    for directory in sys.path:
        try:
            names = os.listdir(directory or '.')
        except OSError:
            continue
        for name in sorted(names):
            stem, extension = os.path.splitext(name)
            if extension not in ('.dist-info', '.egg-info'):
                continue
            distribution = re.sub('[-_.]+', '-', stem.partition('-')[0]).lower()
            path = os.path.join(directory, name, 'entry_points.txt')
            # Of a distribution that is there twice, the first on the path counts.
            if distribution not in seen:
                seen.add(distribution)
                yield path


def _read(path: str) -> Iterator[EntryPoint]:
    try:
        with open(path, encoding='utf-8') as file:
            lines = file.read().splitlines()
    except OSError:
        return
    group = ''
    for line in lines:
        line = line.strip()
        if line.startswith('['):
            group = line.strip('[]')
        elif '=' in line and not line.startswith(('#', ';')):
            name, _, value = line.partition('=')
            yield EntryPoint(name.strip(), group, value.strip())


def get_entry_points(group_name: str) -> Dict[str, EntryPoint]:
    """Return the group's entry points by name."""
    return {
        entry_point.name: entry_point
        for path in _metadata_files() for entry_point in _read(path)
        if entry_point.group == group_name}


def load_entry_points(
    group_name: str, *, exclude_names: Optional[Iterable[str]] = None
) -> Dict[str, Any]:
    """Return what the group's entry points load, by name; one that fails is logged."""
    loaded = {}
    for name, entry_point in get_entry_points(group_name).items():
        if exclude_names and name in exclude_names:
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
