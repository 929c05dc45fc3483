# SPDX-License-Identifier: Apache-2.0
"""Choose the image that a machine starts from; bake, list and delete images of machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import re
import time
from typing import Any, Optional

from fogros2.errors import ConfigurationError, MachineNotFound
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.instances import instances_in, tag_list, tags_of
from fogros2.provider.aws.options import Options
from fogros2.provider.aws.prices import instance_type
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import TAG_BAKED, TAG_DRIVER, TAG_USER, VmCloud, VmId, when
from fogros2.provider.vm.failures import SETTLING, tolerated, unless_gone
from fogros2.provider.vm.images import check_baked, Image, image_parts, image_tags
from fogros2.waiting import wait_until

#: Public parameters of AWS's parameter store, by architecture; ROS 2 Jazzy is for Ubuntu 24.04.
UBUNTU = {
    arch: f'/aws/service/canonical/ubuntu/server/24.04/stable/current/{name}/hvm/ebs-gp3/ami-id'
    for arch, name in (('x86_64', 'amd64'), ('arm64', 'arm64'))}
#: The name of its disk.
ROOT_DEVICE = '/dev/sda1'
#: The same with NVIDIA's driver in it.
DEEP_LEARNING = {
    arch: f'/aws/service/deeplearning/ami/{arch}/base-oss-nvidia-driver-gpu-ubuntu-24.04/'
          'latest/ami-id' for arch in UBUNTU}
_STATES = {'invalid': 'failed', 'error': 'failed', 'transient': 'pending'}


def has_nvidia(kind: MachineType) -> bool:
    """Return whether a type has a GPU that takes NVIDIA's driver."""
    return kind.gpu.upper().startswith('NVIDIA')


class Ec2Images(VmCloud):
    """The part of EC2 that chooses images of types, and makes images of machines."""

    _account: Account

    def named_types(self, region: str, names: Sequence[str]) -> list[MachineType]:
        """
        Return the instance types that a region has, in the order of ``names``.

        :raises ConfigurationError: it has none of them.
        """
        types = {entry['InstanceType']: instance_type(entry) for entry in self._account.call(
            'ec2', region, 'describe_instance_types',
            f'looking for the instance type {" or ".join(names)}',
            # a filter, because one unknown name among InstanceTypes is an error for all
            Filters=[{'Name': 'instance-type', 'Values': list(names)}])['InstanceTypes']}
        if not types:
            raise ConfigurationError(
                f'looking for the instance type {" or ".join(names)} in {region} failed: the '
                'region has no such instance type', 'ros2 fog price shows what it has')
        fitting = [kind for name in names if (kind := types.get(name)) is not None]
        if not fitting:
            raise ConfigurationError(f'machines of the type {" or ".join(names)} run no Ubuntu',
                                     'take one with an x86_64 or arm64 processor')
        return fitting

    def image_for(
        self, region: str, kind: MachineType, options: Options, dependencies: str,
    ) -> Mapping[str, Any]:
        """
        Return the image (an entry of DescribeImages) that a machine starts from.

        :param dependencies: hash of the launch; an image baked with the same is preferred.
        :raises ConfigurationError: the image does not exist, or is for another processor.
        """
        if options.ami_image:
            return self._named(region, kind, options.ami_image)
        if has_nvidia(kind) and not kind.gpus:
            raise ConfigurationError(
                f'{kind.name} has only part of a GPU, which takes another driver',
                "ami_image= of an image with NVIDIA's GRID driver, or another ec2_instance_type=")
        baked = self._baked(region, kind, options, dependencies) if dependencies else None
        if baked is not None:
            return baked
        nvidia = has_nvidia(kind)
        parameter = (DEEP_LEARNING if nvidia else UBUNTU)[kind.arch]
        identity = str(self._account.call(
            'ssm', region, 'get_parameter', f'asking for the image {parameter}',
            Name=parameter)['Parameter']['Value'])
        # the other properties of Ubuntu's are known
        return self._named(region, kind, identity) if nvidia else {
            'ImageId': identity, 'RootDeviceName': ROOT_DEVICE, 'Architecture': kind.arch}

    def _named(self, region: str, kind: MachineType, identity: str) -> Mapping[str, Any]:
        images: Sequence[Mapping[str, Any]] = ()
        with unless_gone():
            images = self._account.call(
                'ec2', region, 'describe_images', f'looking for the image {identity}',
                ImageIds=[identity])['Images']
        if not images:
            raise ConfigurationError(f'there is no image {identity} in {region}',
                                     'an AMI belongs to one region; leave ami_image= out')
        image = images[0]
        if image.get('State', 'available') != 'available':
            raise ConfigurationError(f'the image {identity} in {region} is {image["State"]}',
                                     'ros2 fog image list shows when it is available')
        if image.get('Architecture', kind.arch) != kind.arch:
            raise ConfigurationError(
                f'the image {identity} is for {image["Architecture"]} processors, and {kind.name} '
                f'has {kind.arch}', 'another ec2_instance_type=, or leave ami_image= out')
        return image

    def _baked(
        self, region: str, kind: MachineType, options: Options, dependencies: str,
    ) -> Optional[Mapping[str, Any]]:
        """Return the newest image of FogROS2 with the same dependencies and driver, or None."""
        images = self._account.call(
            'ec2', region, 'describe_images', 'looking for images baked before', Owners=['self'],
            Filters=[{'Name': f'tag:{TAG_DEPENDENCIES}', 'Values': [dependencies]},
                     {'Name': 'tag-key', 'Values': [TAG_BAKED]},
                     {'Name': 'architecture', 'Values': [kind.arch]},
                     {'Name': 'state', 'Values': ['available']}])['Images']
        fitting = [image for image in images
                   if tags_of(image).get(TAG_USER, options.user) == options.user
                   and (TAG_DRIVER in tags_of(image)) is has_nvidia(kind)]
        return max(fitting, key=lambda image: str(image.get('CreationDate', '')), default=None)

    def bake(self, machine: VmId, name: str, dependencies: str) -> str:
        # without a reboot, files of the last half minute may be missing, unless ``sync`` ran
        vm = self.get(machine.region, machine.vm)
        if vm is None:
            raise MachineNotFound(f'EC2 does not know {machine.vm} yet', 'try again')
        what = f"making the image '{name}'"
        (kind,) = self.named_types(vm.region, [vm.kind])
        (entry,) = instances_in(self._account.call(
            'ec2', vm.region, 'describe_instances', what, InstanceIds=[vm.id])['Reservations'])
        # an image has all volumes of its machine, unless they are left out
        others = [str(one['DeviceName']) for one in entry.get('BlockDeviceMappings') or ()
                  if one['DeviceName'] != entry.get('RootDeviceName')]
        listed = tag_list({'Name': name, **image_tags(
            name, vm.tags, dependencies, nvidia=has_nvidia(kind))})
        # names are unique in a region
        stamp = time.strftime('%Y%m%d-%H%M%S', time.gmtime())
        plain = re.sub(r"[^A-Za-z0-9()\[\] ./'@_-]", '-', name)[:80]
        unique = f'fogros2-{plain}-{stamp}'
        with tolerated('InvalidAMIName.Duplicate'):
            answer = self._account.call(
                'ec2', vm.region, 'create_image', what,
                InstanceId=vm.id, Name=unique, NoReboot=True, Description=f'FogROS2: {plain}',
                **({'BlockDeviceMappings': [{'DeviceName': device, 'NoDevice': ''}
                                            for device in others]} if others else {}),
                TagSpecifications=[{'ResourceType': 'image', 'Tags': listed},
                                   {'ResourceType': 'snapshot', 'Tags': listed}])
            return f'aws:{vm.region}/{answer["ImageId"]}'
        # the answer to the first attempt was lost
        images = wait_until(
            lambda: self._account.call(
                'ec2', vm.region, 'describe_images', what, Owners=['self'],
                Filters=[{'Name': 'name', 'Values': [unique]}])['Images'] or None,
            timeout=SETTLING, cancel=self._account.cancel, interval=0.5, longest=4.0,
            what=f'the image {unique}')
        return f'aws:{vm.region}/{images[0]["ImageId"]}'

    def images(self, region: str) -> Iterator[Image]:
        for entry in self._account.pages(
                'ec2', region, 'describe_images', 'Images', 'looking for images', Owners=['self'],
                Filters=[{'Name': 'tag-key', 'Values': [TAG_BAKED]}]):
            tags = tags_of(entry)
            sizes = [int(mapping.get('Ebs', {}).get('VolumeSize') or 0)
                     for mapping in entry.get('BlockDeviceMappings') or ()]
            state = str(entry.get('State', ''))
            yield Image(
                f'aws:{region}/{entry["ImageId"]}', tags.get(TAG_BAKED, ''), 'aws', region,
                created=when(entry.get('CreationDate')), size_gb=sum(sizes) or None,
                state=_STATES.get(state, state), dependencies=tags.get(TAG_DEPENDENCIES, ''),
                tags=tags)

    def delete_image(self, image_id: str) -> None:
        """Delete an image and its snapshots, also those that an earlier attempt left."""
        account = self._account
        region, identity = image_parts(image_id, 'aws:([a-z0-9-]+)/(ami-[0-9a-f]+)')
        what = f'deleting the image {identity}'
        images = account.call('ec2', region, 'describe_images', what, Owners=['self'],
                              Filters=[{'Name': 'image-id', 'Values': [identity]}])['Images']
        snapshots = {str(mapping['Ebs']['SnapshotId'])
                     for image in images for mapping in image.get('BlockDeviceMappings') or ()
                     if mapping.get('Ebs', {}).get('SnapshotId')}
        if images:
            check_baked(tags_of(images[0]), f'{identity} in {region}')
        # EC2 writes the image's id into the description of its snapshots
        snapshots |= {str(entry['SnapshotId']) for entry in account.pages(
            'ec2', region, 'describe_snapshots', 'Snapshots', what, OwnerIds=['self'],
            Filters=[{'Name': 'description', 'Values': [f'*for {identity}*']},
                     {'Name': 'tag-key', 'Values': [TAG_BAKED]}])}
        if images:
            account.remove(region, 'deregister_image', what, ImageId=identity)
        for snapshot in sorted(snapshots):
            account.remove(region, 'delete_snapshot', what, SnapshotId=snapshot)
