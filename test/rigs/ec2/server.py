# SPDX-License-Identifier: Apache-2.0
"""The process behind EC2 in a box."""

from __future__ import annotations

from collections.abc import Mapping
import os
from typing import Any

from rigs.computers import computer, server


class Box(server.Box):
    """One box, with Moto."""

    region_host = 'ec2.{}.amazonaws.com'

    def open(self) -> tuple[Any, Any]:
        """Change Moto, and return the computers and the API in front of it."""
        os.environ.update(
            MOTO_EC2_LOAD_DEFAULT_AMIS='false', MOTO_ENABLE_AMI_VALIDATION='true',
            MOTO_ENABLE_KEYPAIR_VALIDATION='true',
            MOTO_EC2_ENABLE_INSTANCE_TYPE_VALIDATION='true')
        from moto.moto_server.werkzeug_app import create_backend_app, DomainDispatcherApplication

        from rigs.ec2 import hooks
        from rigs.ec2.api import Api
        from rigs.ec2.cloud import Cloud
        cloud = self.computers(Cloud)
        hooks.install(cloud)
        return cloud, Api(DomainDispatcherApplication(create_backend_app), cloud)

    def shown(self, machine: Any) -> dict[str, Any]:
        """Return what Moto knows of an instance."""
        instance = machine.instance
        return {
            'id': instance.id, 'region': instance.region_name, 'state': instance._state.name,
            'type': instance.instance_type, 'image': instance.image_id,
            'zone': str(instance.availability_zone), 'public': instance.public_ip or '',
            'private': instance.private_ip or '', 'reason': instance.state_reason.code or '',
            'tags': {tag['key']: tag['value'] for tag in instance.get_tags()}}

    def do(self, order: Mapping[str, Any]) -> Any:
        """Publish an image."""
        from rigs.ec2 import hooks
        from rigs.ec2.market import PublicImage
        if order['do'] == 'publish':
            hooks.publish(order['region'], PublicImage(
                order['image'], 'published', 'x86_64', '099720109477'))
            if order['files']:
                computer.new_disk(self.cloud.disks / order['image'])
                computer.put_files(self.cloud.disks / order['image'], order['files'])
        else:
            super().do(order)


if __name__ == '__main__':
    server.main(Box)
