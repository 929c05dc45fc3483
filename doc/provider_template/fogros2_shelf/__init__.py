# SPDX-License-Identifier: Apache-2.0
"""
A provider that lends the computers of a shared folder, the shelf, to one launch each.

``robot-3.json`` in that folder describes a computer: ``{"host": "10.0.0.3", "host_key": "..."}``.
``robot-3.loan`` is there while a launch has the computer; it keeps the tags of the machine, and
the key that may log in: ``jq -r .key /srv/shelf/robot-3.loan`` is robot-3's AuthorizedKeysCommand
of sshd.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import contextlib
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
    """Computers of a shared folder; FogROS2 makes an object for each launch and each command."""

    name = 'shelf'
    capabilities = Capabilities()
    poll_interval = 0.1

    def __init__(self) -> None:
        self._folders = {Options.folder}

    def check(self, spec: MachineSpec) -> None:
        """Check the options."""
        _options(spec)

    def search_for(self, specs: Iterable[MachineSpec]) -> None:
        """Search the folders of these machines, too."""
        self._folders.update(_options(spec).folder for spec in specs)

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Borrow a free computer."""
        options = _options(spec)
        folder = Path(options.folder)
        for path, loan in _loans(folder):
            if loan['token'] == request.token:
                return _id(path, loan)
            if loan['name'] == spec.name:
                raise NameTaken(f"the shelf has lent a computer as '{spec.name}' already",
                                f'ros2 fog delete {spec.name}')
        loan = {'token': request.token, 'name': spec.name, 'user': options.user,
                'key': request.authorized_key, 'created': time.time(), 'tags': dict(request.tags)}
        new = folder / f'{request.token}.new'
        for computer in sorted(folder.glob('*.json')):
            path = computer.with_suffix('.loan')
            new.write_text(json.dumps({**json.loads(computer.read_text()), **loan}))
            try:
                os.link(new, path)  # fails if another launch was faster
            except FileExistsError:
                continue
            finally:
                new.unlink()
            return _id(path, loan)
        raise ProviderError(f'no computer in {folder} is free', 'ros2 fog list')

    def describe(self, machine_id: str) -> Machine:
        """Return a computer that is lent."""
        for path, loan in _loans(Path(machine_id).parent):
            if _id(path, loan) == machine_id:
                return self._machine(path, loan)
        raise MachineNotFound(f"'{machine_id}' is no loan of the shelf")

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """Yield the computers that are lent with these tags."""
        for folder in sorted(self._folders):
            for path, loan in _loans(Path(folder)):
                if tags.items() <= loan['tags'].items():
                    yield self._machine(path, loan)

    def destroy(self, machine_id: str) -> None:
        """Give a computer back."""
        for path, loan in _loans(Path(machine_id).parent):
            if _id(path, loan) == machine_id:
                path.unlink(missing_ok=True)

    def _machine(self, path: Path, loan: Mapping[str, Any]) -> Machine:
        return Machine(
            _id(path, loan), loan['name'], self.name, MachineState.RUNNING,
            created=loan['created'], tags=loan['tags'], vpn_host=loan['host'],
            endpoint=Endpoint('ssh', loan['host'], user=loan['user'], host_key=loan['host_key']),
            # nothing is billed; the computer must only stop the work of the launch
            end_command=('systemctl', 'reboot'))


def _options(spec: MachineSpec) -> Options:
    return parsed(Options, spec.options, 'a computer of the shelf')


def _loans(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for path in sorted(folder.glob('*.loan')):
        with contextlib.suppress(FileNotFoundError):  # just given back
            yield path, json.loads(path.read_text())


def _id(path: Path, loan: Mapping[str, Any]) -> str:
    """Return the id of a machine, by which any process finds it again."""
    return f'{path}:{loan["token"]}'
