# SPDX-License-Identifier: Apache-2.0
"""The process behind Compute Engine in a box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rigs.computers import server


class Box(server.Box):
    """One box."""

    region_host = 'compute.{}.rep.googleapis.com'

    def open(self) -> tuple[Any, Any]:
        """Return the computers and the API in front of them."""
        from rigs.gce import keys
        from rigs.gce.api import Api
        from rigs.gce.cloud import Cloud
        from rigs.gce.resources import Project
        cloud = self.computers(Cloud)
        project = Project(cloud, name=self.settings['project'])
        return cloud, Api(project, keys.public(self.settings['key']))

    def shown(self, machine: Any) -> dict[str, Any]:
        """Return an instance, with its labels as tags."""
        instance = machine.instance
        zone = instance['zone'].rpartition('/')[2]
        return {
            'id': machine.id, 'region': zone[:-2], 'state': machine.state, 'zone': zone,
            'type': instance['machineType'].rpartition('/')[2], 'image': machine.disk_of,
            'public': machine.public, 'private': machine.private, 'reason': machine.reason,
            'tags': instance['labels']}

    def do(self, order: Mapping[str, Any]) -> Any:
        """Delete all resources, return their names, or a firewall rule."""
        if order['do'] == 'clear':
            self.api.project.clear()
        elif order['do'] == 'things':
            project = self.api.project
            with project.lock:
                return {'instances': [i['name'] for i in project.instances.values()],
                        'disks': [disk['name'] for disk in project.disks()],
                        'firewalls': [name for name in project.firewalls
                                      if not name.startswith('default-')],
                        'images': [name for owner, name in project.images
                                   if owner == project.name]}
        elif order['do'] == 'firewall':
            with self.api.project.lock:
                return self.api.project.firewalls[order['name']]
        else:
            super().do(order)
        return None


if __name__ == '__main__':
    server.main(Box)
