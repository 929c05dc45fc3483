# SPDX-License-Identifier: Apache-2.0
"""Install plugins for the duration of a test."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import os
from pathlib import Path
from typing import Any, Union

import pytest

from fogros2 import plugin_system
from fogros2.errors import FogError, MachineNotFound, ProviderError
from fogros2.model import CreateRequest, Machine, MachineSpec
from fogros2.provider import Provider


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

    def loaded(asked: str, name: str) -> Any:
        if asked != group:
            return load(asked, name)
        plugin = known[name]
        if isinstance(plugin, FogError):
            raise plugin
        return plugin

    patch.setattr(plugin_system, 'names', lambda asked: (
        list(known) if asked == group else names(asked)))
    patch.setattr(plugin_system, 'load', loaded)


class MemoryProvider(Provider):
    """A provider whose machines a test writes to the dictionary ``machines`` of the class."""

    machines: dict[str, Machine]

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Refuse, because the test creates the machines."""
        raise ProviderError(f"'{spec.name}' can't be made: the test makes its machines itself")

    def describe(self, machine_id: str) -> Machine:
        """Return a machine by its id."""
        if machine_id not in self.machines:
            raise MachineNotFound(machine_id)
        return self.machines[machine_id]

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """Return the machines that have the tags."""
        return [machine for machine in self.machines.values()
                if tags.items() <= machine.tags.items()]

    def destroy(self, machine_id: str) -> None:
        """Forget a machine."""
        self.machines.pop(machine_id, None)
