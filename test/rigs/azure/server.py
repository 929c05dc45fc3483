# SPDX-License-Identifier: Apache-2.0
"""The process behind Azure in a box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fogros2.waiting import Periodic
from rigs.azure import service
from rigs.azure.cloud import Cloud
from rigs.computers import server


class Box(server.Box):
    """One box."""

    region_host = '{}.handler.control.monitor.azure.com'

    def open(self) -> tuple[Any, Any]:
        """Return the computers, and the service in front of them."""
        cloud = self.computers(Cloud)
        cloud.azure = service.Service(cloud, delay=0.2, ghost=2.0)
        # one lock: the service and the computers change each other's states
        cloud.azure.lock = cloud.lock
        Periodic('tick', 0.1, self._tick)
        return cloud, cloud.azure

    def _tick(self) -> None:
        with self.cloud.lock:
            self.api.tick()

    def shown(self, machine: Any) -> dict[str, Any]:
        """Return what Azure knows of a machine."""
        vm = machine.instance
        with self.cloud.lock:
            there = vm['id'].lower() in self.api.resources
            return {
                'id': vm['name'], 'region': vm['location'],
                'state': vm.get('_power', 'pending') if there else 'terminated',
                'type': vm['properties']['hardwareProfile']['vmSize'],
                'image': str(vm['properties']['storageProfile']['imageReference'].get('id', '')),
                'zone': '', 'public': machine.public, 'private': machine.private,
                'reason': machine.reason, 'tags': dict(vm.get('tags', {}))}

    def do(self, order: Mapping[str, Any]) -> Any:
        """Change the user's rights, delete all groups, or show all resources."""
        what = order['do']
        if what == 'rights':
            self.api.rights = service.OPERATOR if order['owner'] else service.CONTRIBUTOR
            self.api.propagation = order['propagation']
        elif what == 'things':
            with self.cloud.lock:
                return {'groups': {group['name']: group for group in self.api.groups.values()},
                        'resources': {entry['id']: service.plain(entry)
                                      for entry in self.api.resources.values()}}
        elif what == 'clear':
            with self.cloud.lock:
                for name in list(self.api.groups):
                    self.api.groups[name]['properties']['provisioningState'] = 'Deleting'
                    self.api.later(name, lambda name=name: self.api.drop(name),
                                   location=True)
        else:
            return super().do(order)
        return None


if __name__ == '__main__':
    server.main(Box)
