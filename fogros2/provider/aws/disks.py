# SPDX-License-Identifier: Apache-2.0
"""EBS disks that outlive machines: the tag of a disk is all that is known of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from decimal import Decimal
from typing import Any
import uuid

from fogros2.provider.aws import instances
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.vm.cloud import Disk, TAG_VOLUME, VmCloud, VmId
from fogros2.provider.vm.failures import tolerated

#: Names of devices that EC2 recommends for data.
_DEVICES = [f'/dev/sd{letter}' for letter in 'fghijklmnop']


class Ec2Disks(VmCloud):
    """The part of EC2 that has disks."""

    _account: Account
    gb_month = Decimal('0.08')  # gp3 in us-east-1

    def disks(self, region: str, name: str = '') -> Iterator[Disk]:
        for entry in self._account.pages(
                'ec2', region, 'describe_volumes', 'Volumes', 'looking for volumes', Filters=[
                    {'Name': f'tag:{TAG_VOLUME}', 'Values': [name]} if name else
                    {'Name': 'tag-key', 'Values': [TAG_VOLUME]}]):
            users = [one for one in entry.get('Attachments') or () if one['State'] != 'detached']
            if entry['State'] not in ('deleting', 'deleted'):
                yield Disk(
                    str(entry['VolumeId']), instances.tags_of(entry)[TAG_VOLUME], region,
                    str(entry['AvailabilityZone']), int(entry['Size']),
                    ''.join(str(one['InstanceId']) for one in users),
                    entry['State'] in ('available', 'in-use')
                    and all(one['State'] == 'attached' for one in users),
                    entry['CreateTime'].timestamp())

    def make_disk(self, machine: VmId, name: str, size_gb: int) -> str:
        # gp3 is the cheapest of the fast ones
        return str(self._account.call(
            'ec2', machine.region, 'create_volume', f"making the volume '{name}'",
            AvailabilityZone=self._instance(machine)['Placement']['AvailabilityZone'],
            Size=size_gb, VolumeType='gp3', Encrypted=True,
            ClientToken=str(uuid.uuid4()),  # a repeated request makes no second one
            TagSpecifications=[{'ResourceType': 'volume', 'Tags': instances.tag_list(
                {TAG_VOLUME: name, 'Name': f'fogros2 {name}'})}])['VolumeId'])

    def attach_disk(self, machine: VmId, disk: Disk) -> tuple[str, ...]:
        taken = self._devices(machine)
        device = next((name for name, held in taken.items() if held == disk.id), '')
        if not device:
            device = next(name for name in _DEVICES if name not in taken)
            try:
                self._account.call(
                    'ec2', machine.region, 'attach_volume', f"attaching the volume '{disk.name}'",
                    VolumeId=disk.id, InstanceId=machine.vm, Device=device)
            except AwsError:
                # the answer to the first attempt may have been lost
                if self._devices(machine).get(device) != disk.id:
                    raise
        # by the disk's number, which Nitro's NVMe tells; by name on older instances
        return (f'/dev/disk/by-id/nvme-Amazon_Elastic_Block_Store_{disk.id.replace("-", "")}',
                device.replace('sd', 'xvd'), device)

    def detach_disk(self, machine: VmId, disk: Disk) -> None:
        with tolerated('IncorrectState'):  # it is detached
            self._account.call(
                'ec2', machine.region, 'detach_volume', f"detaching the volume '{disk.name}'",
                VolumeId=disk.id, InstanceId=machine.vm)

    def delete_disk(self, disk: Disk) -> None:
        self._account.remove(disk.region, 'delete_volume', f"deleting the volume '{disk.name}'",
                             VolumeId=disk.id)

    def _devices(self, machine: VmId) -> dict[str, str]:
        """Return the ids of a machine's disks by their devices."""
        return {str(entry['DeviceName']): str(entry['Ebs']['VolumeId'])
                for entry in self._instance(machine).get('BlockDeviceMappings') or ()}

    def _instance(self, machine: VmId) -> Mapping[str, Any]:
        return instances.instances_in(self._account.call(
            'ec2', machine.region, 'describe_instances', f'looking for {machine.vm}',
            InstanceIds=[machine.vm])['Reservations'])[0]
