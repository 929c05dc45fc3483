# SPDX-License-Identifier: Apache-2.0
"""Install plugins for the duration of a test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import os
from pathlib import Path
from typing import Any, Union

import pytest

from fogros2 import plugin_system
from fogros2.errors import FogError


def install(folder: Path, group: str, name: str, program: str, attribute: str) -> str:
    """
    Write a distribution with one entry point; return the PYTHONPATH that includes it.

    Processes that a test starts with this PYTHONPATH find the plugin too.

    :param folder: an empty folder.
    :param group: entry-point group, such as ``fogros2.provider``.
    :param name: name of the plugin.
    :param program: source text of the plugin's module.
    :param attribute: name of the class in the module.
    """
    module = f'fogt_{name}'
    about = folder / f'{module}-0.dist-info'
    about.mkdir(parents=True)
    (about / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {module}\nVersion: 0\n')
    (about / 'entry_points.txt').write_text(f'[{group}]\n{name} = {module}:{attribute}\n')
    (folder / f'{module}.py').write_text(program)
    before = os.environ.get('PYTHONPATH')
    return f'{folder}{os.pathsep}{before}' if before else str(folder)


def instead(
    patch: pytest.MonkeyPatch, group: str,
    known: Mapping[str, Union[Callable[..., Any], FogError]],
) -> None:
    """
    Replace all plugins of a group in this process.

    :param known: by name, the class or a function that makes one, or the error that loading it
        raises.
    """
    names, load = plugin_system.names, plugin_system.load

    def loaded(wanted: str, name: str) -> Any:
        if wanted != group:
            return load(wanted, name)
        plugin = known[name]
        if isinstance(plugin, FogError):
            raise plugin
        return plugin

    patch.setattr(plugin_system, 'names', lambda wanted: (
        list(known) if wanted == group else names(wanted)))
    patch.setattr(plugin_system, 'load', loaded)
