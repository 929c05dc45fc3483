# SPDX-License-Identifier: Apache-2.0
"""
Moto, changed so that a box's instances are real: addresses, starts, ends, images.

Everything here replaces a method of Moto's for the life of this process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import copy
from typing import Any

from moto.ec2 import models

from rigs.ec2.cloud import Cloud, MOTO
from rigs.ec2.market import ENABLED, PublicImage

#: Moto's account.
ACCOUNT = '123456789012'


def install(cloud: Cloud) -> None:
    """Put ``cloud`` behind Moto's EC2, and its addresses in the place of Moto's inventions."""
    parts: Any = models  # its modules are replaced in part, which no type allows
    amis, instances = parts.amis, parts.instances

    def public_address() -> str:
        return cloud.addresses.take()

    def private_address(*_: Any, **__: Any) -> str:
        return cloud.addresses.take(private=True)

    parts.elastic_network_interfaces.random_public_ip = public_address
    parts.elastic_network_interfaces.random_private_ip = private_address
    parts.elastic_ip_addresses.random_ip = public_address
    instances.random_private_ip = private_address
    parts.subnets.Subnet.get_available_subnet_ip = private_address

    known = parts.availability_zones_and_regions.RegionsAndZonesBackend
    known.regions = [region for region in known.regions if region.name in ENABLED]

    MOTO.update(
        start=instances.Instance.start, stop=instances.Instance.stop,
        terminate=instances.Instance.terminate, run=instances.InstanceBackend.run_instances,
        image=amis.AmiBackend.create_image, deregister=amis.AmiBackend.deregister_image,
        attach=parts.elastic_block_store.EBSBackend.attach_volume,
        detach=parts.elastic_block_store.EBSBackend.detach_volume)

    def run_instances(self: Any, *args: Any, **kwargs: Any) -> Any:
        reservation = MOTO['run'](self, *args, **kwargs)
        for instance in reservation.instances:
            cloud.launch(
                str(instance.id), instance, spot=bool(kwargs.get('instance_market_options')),
                disk_of=str(instance.image_id))
        return reservation

    def start(self: Any) -> Any:
        with cloud.lock:
            before = copy.copy(self._state)
            if before.name == 'stopped':
                MOTO['start'](self)
                cloud.start(str(self.id))
        return before

    def stop(self: Any) -> Any:
        before = copy.copy(self._state)
        if before.name in ('pending', 'running'):
            cloud.end(str(self.id), 'stop')
        return before

    def terminate(self: Any) -> Any:
        before = copy.copy(self._state)
        if before.name not in ('shutting-down', 'terminated'):
            cloud.end(str(self.id), 'terminate')
        return before

    def create_image(
        self: Any, instance_id: str, name: str, description: str,
        tag_specifications: Sequence[Mapping[str, Any]],
    ) -> Any:
        of_snapshot = [spec for spec in tag_specifications if spec['ResourceType'] == 'snapshot']
        others = [spec for spec in tag_specifications if spec['ResourceType'] != 'snapshot']
        image = MOTO['image'](self, instance_id, name, description, others)
        for spec in of_snapshot:
            image.ebs_snapshot.add_tags({tag['Key']: tag['Value'] for tag in spec['Tags']})
        cloud.image(image, self.get_instance(instance_id))
        return image

    def deregister_image(self: Any, ami_id: str) -> Any:
        answer = MOTO['deregister'](self, ami_id)
        cloud.forget_image(ami_id)
        return answer

    def attach_volume(
        self: Any, volume_id: str, instance_id: str, *args: Any, **kwargs: Any,
    ) -> Any:
        answer = MOTO['attach'](self, volume_id, instance_id, *args, **kwargs)
        # as Nitro's NVMe shows it
        cloud.attach(instance_id, volume_id, int(self.get_volume(volume_id).size),
                     '/dev/disk/by-id/nvme-Amazon_Elastic_Block_Store_'
                     + volume_id.replace('-', ''))
        return answer

    def detach_volume(self: Any, volume_id: str, instance_id: str, device_path: str) -> Any:
        cloud.detach(instance_id, volume_id)
        return MOTO['detach'](self, volume_id, instance_id, device_path)

    parts.elastic_block_store.EBSBackend.attach_volume = attach_volume
    parts.elastic_block_store.EBSBackend.detach_volume = detach_volume
    for name, method in (('start', start), ('stop', stop), ('terminate', terminate)):
        setattr(instances.Instance, name, method)
    instances.InstanceBackend.run_instances = run_instances
    amis.AmiBackend.create_image = create_image
    amis.AmiBackend.deregister_image = deregister_image


def publish(region: str, image: PublicImage) -> None:
    """Let a region have a published AMI."""
    backend = backend_of(region)
    if image.id not in backend.amis:
        backend.amis[image.id] = models.amis.Ami(
            backend, image.id, name=image.name, owner_id=image.owner, owner_alias='amazon',
            public=True, virtualization_type='hvm', architecture=image.architecture,
            hypervisor='xen', root_device_type='ebs', root_device_name='/dev/sda1',
            region_name=f'{region}a')


def backend_of(region: str) -> Any:
    """Return Moto's EC2 of a region."""
    return models.ec2_backends[ACCOUNT][region]
