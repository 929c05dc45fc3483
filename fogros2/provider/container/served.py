# SPDX-License-Identifier: Apache-2.0
"""
The program on a host that serves container machines there to robots: one call for each run.

``hosted`` sends it with the modules that it imports; Python's standard library has the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import json
import signal
import sys
import threading
from typing import Any

from fogros2 import model
from fogros2.errors import FogError
from fogros2.model import CreateRequest, Machine, MachineSpec
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container import machine as container_machine


@dataclasses.dataclass(frozen=True)
class Report:
    """
    A container machine as its host reports it to a robot.

    :param id: the id of :class:`ContainerProvider` on the host.
    :param created: seconds since the epoch.
    :param user: login user; ``host_key`` is '' while a connection cannot be tried.
    :param address: the container's address, for other containers on the host.
    :param ssh_port: TCP port of the host that leads to its SSH server; ``vpn_port`` likewise the
        UDP port of its VPN.
    """

    id: str = ''
    state: str = ''
    created: int = 0
    user: str = ''
    host_key: str = ''
    address: str = ''
    image: str = ''
    ssh_port: int = 0
    vpn_port: int = 0
    tags: Mapping[str, str] = dataclasses.field(default_factory=dict)


def report(machine: Machine) -> Report:
    """Return the report of a machine of :class:`ContainerProvider`."""
    engine, identity, _ = container_machine.parse_id(machine.id)
    found = engine.inspect([identity])
    ssh_port, vpn_port = container_machine.published(found[0]) if found else (0, 0)
    shell = machine.shell or model.Endpoint('ssh')
    return Report(
        machine.id, str(machine.state), int(machine.created or 0), shell.user,
        shell.host_key or '', machine.vpn_host, machine.image, ssh_port, vpn_port, machine.tags)


def answer(provider: ContainerProvider, call: str, given: Mapping[str, Any]) -> Any:
    """
    Call a method of the provider with arguments that were JSON; return its result for JSON.

    :raises FogError: the method's error.
    """
    if call == 'create':
        spec = MachineSpec(**given['spec'])
        provider.check(spec)
        return provider.create(spec, CreateRequest(**given['request']))
    if call == 'find':
        return [report(machine) for machine in provider.find(given['tags'])]
    if call == 'describe':
        return report(provider.describe(given['id']))
    return {'destroy': provider.destroy, 'stop': provider.stop,
            'start': provider.start}[call](given['id'])


def main() -> None:
    """Read one call from the standard input, and print its result or its error in one line."""
    provider, ask = ContainerProvider(), json.load(sys.stdin)
    provider.cancel = cancel = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: cancel.set())
    try:
        said = {'result': answer(provider, ask['call'], ask['given'])}
    except FogError as error:
        said = {'error': type(error).__name__, 'message': error.args[0], 'hint': error.hint}
    print(model.to_json(said))


if __name__ == '__main__':
    main()
