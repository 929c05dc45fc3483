# SPDX-License-Identifier: Apache-2.0
"""
A provider that lends the computers of a shared folder, the shelf, to one launch each.

``robot-3.json`` in that folder describes a computer: ``{"host": "10.0.0.3", "host_key": "..."}``.
``robot-3.loan`` is there while a launch has the computer; it keeps the tags of the machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
import json
import os
from pathlib import Path
import time
from typing import Any

from fogros2.errors import MachineNotFound, NameTaken, ProviderError
from fogros2.model import CreateRequest, Endpoint, Machine, MachineSpec, MachineState
from fogros2.provider import Capabilities, Provider
from fogros2.provider.options import parsed


@dataclasses.dataclass(frozen=True)
class Options:
    """
    Options of a computer of the shelf.

    :param folder: the shelf's folder.
    :param user: login user.
    """

    folder: str = os.environ.get('SHELF', '/srv/shelf')
    user: str = 'ubuntu'


class ShelfProvider(Provider):
    """Computers of a shared folder."""

    name = 'shelf'
    capabilities = Capabilities()
    poll_interval = 0.1

    def __init__(self, folder: str = Options.folder) -> None:
        self._folder = Path(folder)

    def check(self, spec: MachineSpec) -> None:
        """Check the options."""
        parsed(Options, spec.options, 'a computer of the shelf')

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Borrow a free computer."""
        options = parsed(Options, spec.options, 'a computer of the shelf')
        self._folder = Path(options.folder)
        for path, loan in self._loans():
            if loan['token'] == request.token:
                return self._id(path, loan)
            if loan['tags'].get('fogros2-name') == spec.name:
                raise NameTaken(f"the shelf has lent a computer as '{spec.name}' already",
                                f'ros2 fog delete {spec.name}')
        loan = {'token': request.token, 'name': spec.name, 'user': options.user,
                'created': time.time(), 'tags': dict(request.tags)}
        for computer in sorted(self._folder.glob('*.json')):
            path = computer.with_suffix('.loan')
            try:
                with open(path, 'x') as file:  # fails if another launch was faster
                    json.dump(loan, file)
            except FileExistsError:
                continue
            return self._id(path, loan)
        raise ProviderError(f'no computer in {self._folder} is free', 'ros2 fog list')

    def describe(self, machine_id: str) -> Machine:
        """Return a computer that is lent."""
        for path, loan in self._loans():
            if self._id(path, loan) == machine_id:
                return self._machine(path, loan)
        raise MachineNotFound(f"'{machine_id}' is no loan of the shelf")

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """Yield the computers that are lent with these tags."""
        for path, loan in self._loans():
            if tags.items() <= loan['tags'].items():
                yield self._machine(path, loan)

    def destroy(self, machine_id: str) -> None:
        """Give a computer back."""
        for path, loan in self._loans():
            if self._id(path, loan) == machine_id:
                path.unlink(missing_ok=True)

    def _loans(self) -> Iterator[tuple[Path, dict[str, Any]]]:
        for path in sorted(self._folder.glob('*.loan')):
            yield path, json.loads(path.read_text())

    def _id(self, path: Path, loan: Mapping[str, Any]) -> str:
        return f'shelf:{path.stem}/{loan["token"]}'

    def _machine(self, path: Path, loan: Mapping[str, Any]) -> Machine:
        computer = json.loads(path.with_suffix('.json').read_text())
        return Machine(
            self._id(path, loan), loan['name'], self.name, MachineState.RUNNING,
            created=loan['created'], tags=loan['tags'], vpn_host=computer['host'],
            endpoint=Endpoint('ssh', computer['host'], user=loan['user'],
                           host_key=computer['host_key']),
            # nothing is billed; the computer must only stop the work of the launch
            end_command=('systemctl', 'reboot'))
