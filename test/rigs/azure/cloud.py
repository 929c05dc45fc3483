# SPDX-License-Identifier: Apache-2.0
"""The computers behind the machines of the simulated Azure."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from email.message import Message
import hashlib
import json
import sys
import threading
import time
from typing import Any
from urllib.parse import parse_qs, urlsplit

from fogros2.errors import FogError
from rigs.azure import service
from rigs.computers import cloud, cloud_config, network
from rigs.computers.cloud import BY_ITSELF, BY_SPOT, Machine
from rigs.computers.metadata import MetadataService


class Cloud(cloud.Cloud, service.Computers):
    """The computers of Azure in a box; ``azure`` is the service in front of them."""

    azure: service.Service

    # -- what the service asks for --------------------------------------------------------------

    def take_address(self, *, private: bool = False) -> str:
        """Return an address of the test network."""
        return self.addresses.take(private=private)

    def begin(self, vm: dict[str, Any]) -> None:
        """Give a machine a computer."""
        image = vm['properties']['storageProfile']['imageReference']
        self.launch(vm['name'], vm, spot=vm['properties'].get('priority') == 'Spot',
                    disk_of=disk_name(image['id']) if 'id' in image else 'ubuntu')

    def begin_again(self, vm: dict[str, Any]) -> None:
        """Switch a computer on."""
        self.start(vm['name'])

    def off(self, vm: dict[str, Any], *, forever: bool = False) -> bool:
        """Press the power button; return whether the computer is off."""
        machine = self.machines.get(vm['name'])
        if machine is None:
            return True
        self.end(machine.id, 'terminate' if forever else 'stop')
        return machine.state in (('terminated',) if forever else ('stopped', 'terminated'))

    def copy_disk(self, vm: dict[str, Any], image: str) -> None:
        """Copy a computer's disk in the background."""
        def copy() -> None:
            try:
                self.copy(vm['name'], disk_name(image))
            except (FogError, OSError) as error:
                print(f'{image}: {error}', file=sys.stderr, flush=True)

        thread = threading.Thread(target=copy, daemon=True)
        thread.start()

    # -- what the computers ask for -------------------------------------------------------------

    def user_data(self, machine: Machine) -> bytes:
        """Return the customData."""
        return base64.b64decode(machine.instance['properties']['osProfile']['customData'])

    def plan(self, machine: Machine) -> dict[str, Any]:
        """Return what customData and the login key say."""
        system = machine.instance['properties']['osProfile']
        return {**cloud_config.parse(self.user_data(machine)),
                'instance': machine.instance['properties']['vmId'],
                'user': system['adminUsername'],
                'keys': [key['keyData'] for key in
                         system['linuxConfiguration']['ssh']['publicKeys']]}

    def _nic(self, machine: Machine) -> dict[str, Any]:
        (nic,) = machine.instance['properties']['networkProfile']['networkInterfaces']
        return self.azure.resources[nic['id'].lower()]

    def network_of(self, machine: Machine) -> str:
        """Return the virtual network."""
        (one,) = self._nic(machine)['properties']['ipConfigurations']
        return str(one['properties']['subnet']['id']).lower().partition('/subnets/')[0]

    def allowed(
        self, machine: Machine, members: Mapping[str, Sequence[str]],
    ) -> tuple[network.Allowed, ...]:
        """Return what the rules let in, by priority, with Azure's own last ones."""
        if machine.id not in self.machines or (nic := self._nic_or_none(machine)) is None:
            return ()
        group = nic['properties']['networkSecurityGroup']['id'].lower()
        rules = sorted((entry['properties'] for key, entry in self.azure.resources.items()
                        if key.startswith(f'{group}/securityrules/')),
                       key=lambda rule: int(rule['priority']))
        found: list[network.Allowed] = []
        for rule in rules:
            sources = rule.get('sourceAddressPrefixes') or [rule['sourceAddressPrefix']]
            ports = rule['destinationPortRange']
            first, _, last = ports.partition('-')
            found.append(network.Allowed(
                '-1' if rule['protocol'] == '*' else rule['protocol'].lower(),
                None if ports == '*' else (int(first), int(last or first)),
                tuple('0.0.0.0/0' if source == '*' else source for source in sources),
                accept=rule['access'] == 'Allow'))
        # AllowVnetInBound: everything from the virtual network
        return (*found, network.Allowed('-1', None, tuple(
            members.get(self.network_of(machine), ()))))

    def _nic_or_none(self, machine: Machine) -> Any:
        (nic,) = machine.instance['properties']['networkProfile']['networkInterfaces']
        return self.azure.resources.get(nic['id'].lower())

    def groups_of(self, machine: Machine) -> Sequence[str]:
        """Return the virtual network, whose machines reach each other by default."""
        return [self.network_of(machine)] if self._nic_or_none(machine) else []

    def serve_metadata(self, machine: Machine) -> MetadataService:
        """Serve IMDS: the machine, a token of its identity, and the scheduled events."""
        vm = machine.instance

        def answer(path: str, query: Mapping[str, list[str]]) -> tuple[int, Any]:
            if path == 'instance/compute':
                return 200, {
                    'name': vm['name'], 'location': vm['location'], 'resourceId': vm['id'],
                    'resourceGroupName': vm['id'].split('/')[4],
                    'subscriptionId': service.SUBSCRIPTION, 'vmId': vm['properties']['vmId'],
                    'tagsList': [{'name': key, 'value': value}
                                 for key, value in vm.get('tags', {}).items()]}
            if path == 'identity/oauth2/token' and 'resource' in query:
                if 'identity' not in vm:
                    return 400, {'error': 'invalid_request',
                                 'error_description': 'Identity not found'}
                return 200, {'access_token': f'token-of-{vm["identity"]["principalId"]}'}
            if path == 'scheduledevents':
                events = [{'EventId': '1', 'EventType': 'Preempt', 'ResourceType':
                           'VirtualMachine', 'Resources': [vm['name']], 'EventStatus':
                           'Scheduled', 'NotBefore': time.strftime(
                               '%a, %d %b %Y %H:%M:%S GMT', time.gmtime(machine.notice))},
                          ] if machine.notice else []
                return 200, {'DocumentIncarnation': len(events), 'Events': events}
            return 404, {'error': 'Not found'}

        def answers(method: str, target: str, headers: Message) -> tuple[int, str]:
            parts = urlsplit(target)
            query = parse_qs(parts.query)
            good = headers.get('Metadata') == 'true' and 'api-version' in query
            status, value = answer(parts.path.removeprefix('/metadata/'), query) if good else (
                400, {'error': 'Bad request'})
            return status, json.dumps(value)

        return MetadataService(machine.space, answers)

    def at_shutdown(self, machine: Machine) -> str:
        """Stop: Azure keeps a machine that powers itself off, and bills it on."""
        return 'stop'

    def changed(self, machine: Machine) -> None:
        """Show what a machine did by itself."""
        vm = machine.instance
        if machine.state == 'pending':
            (one,) = self._nic(machine)['properties']['ipConfigurations']
            address = one['properties']['publicIPAddress']['id'].lower()
            machine.public = self.azure.resources[address]['properties']['ipAddress']
            machine.private = one['properties']['privateIPAddress']
        elif machine.state == 'stopped' and machine.reason == BY_ITSELF:
            self.azure.turned_off(vm['id'])
        elif machine.state == 'terminated' and machine.reason == BY_SPOT:
            self.azure.evict(vm['id'])


def disk_name(image: str) -> str:
    """Return the name of the disk of a gallery's image version."""
    return hashlib.sha256(image.lower().encode()).hexdigest()[:16]
