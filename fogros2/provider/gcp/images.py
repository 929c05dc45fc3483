# SPDX-License-Identifier: Apache-2.0
"""Choose the image that a machine starts from; bake, list and delete images of machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import re
import time
from typing import Any

from fogros2.errors import ConfigurationError, MachineNotFound, ProviderError
from fogros2.model import Image
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.gcp.account import Account
from fogros2.provider.gcp.failures import GoogleError
from fogros2.provider.gcp.instances import RULES
from fogros2.provider.gcp.options import Options
from fogros2.provider.vm.cloud import TAG_BAKED, TAG_USER, Vm, when

#: Families of images, by architecture; ROS 2 Jazzy is for Ubuntu 24.04.
UBUNTU = 'projects/ubuntu-os-cloud/global/images/family/ubuntu-2404-lts-'
#: The same with NVIDIA's driver in it.
ACCELERATED = 'projects/ubuntu-os-accelerator-images/global/images/family/' \
    'ubuntu-accelerator-2404-{}-with-nvidia-580'
_STATES = {'READY': 'available', 'DELETING': 'deleted'}
_ARCHES = {'x86_64': 'amd64', 'arm64': 'arm64'}


def choose(
    account: Account, options: Options, arch: str, gpus: bool, dependencies: str,
) -> tuple[str, int]:
    """
    Return the path of the image that a machine starts from, and the size of its disk in GB.

    :raises ConfigurationError: the image does not exist, or is for another processor.
    """
    if options.ami_image:
        return _named(account, options.ami_image, arch)
    fitting = [image for image in account.pages(
        f'{account.project}/global/images', 'looking for images baked before',
        filter=f'(labels.{TAG_BAKED}:*) (labels.{TAG_DEPENDENCIES} = "{dependencies}")')
        if image['status'] == 'READY' and image.get('architecture', 'X86_64').lower() == arch
        and image['labels'].get(TAG_USER) == RULES.encode({'': options.user})['']
    ] if dependencies else []
    if fitting:
        newest = max(fitting, key=lambda image: when(image['creationTimestamp']) or 0.0)
        return (f'projects/{account.project}/global/images/{newest["name"]}',
                int(newest['diskSizeGb']))
    return (ACCELERATED.format(_ARCHES[arch]) if gpus else f'{UBUNTU}{_ARCHES[arch]}'), 10


def _named(account: Account, name: str, arch: str) -> tuple[str, int]:
    short = name.removeprefix('global/images/')
    path = name if name.startswith('projects/') \
        else f'projects/{account.project}/global/images/{short}'
    try:
        image = account.call('GET', path.removeprefix('projects/'),
                             f'looking for the image {name}')
    except GoogleError as error:
        if not error.gone:
            raise
        raise ConfigurationError(f"there is no image '{name}'",
                                 'leave ami_image= out for Ubuntu 24.04') from error
    if image.get('architecture', arch).lower() != arch:
        raise ConfigurationError(
            f"the image '{name}' is for {image['architecture']} processors, and the machine has "
            f'{arch}', 'another machine_type=, or leave ami_image= out')
    return path, int(image.get('diskSizeGb', 10))


def bake(account: Account, vm: Vm, name: str, dependencies: str) -> str:
    """Make an image of the disk of a running instance, and return its id."""
    project, zone, instance = vm.id.split('/')
    stamp = time.strftime('%Y%m%d-%H%M%S', time.gmtime())
    plain = re.sub('[^a-z0-9-]', '-', name.lower())[:36]
    own = f'fogros2-{plain}-{stamp}'
    tags = {TAG_BAKED: name, TAG_USER: vm.tags.get(TAG_USER, ''), TAG_DEPENDENCIES: dependencies}
    account.call(
        'POST', f'{project}/global/images', f"making the image '{name}'", forceCreate='true',
        body={'name': own, 'sourceDisk': f'projects/{project}/zones/{zone}/disks/{instance}',
              'labels': RULES.encode({key: value for key, value in tags.items() if value}),
              'storageLocations': [vm.region]})
    return f'gcp:{vm.region}/{project}/{own}'


def images_in(account: Account, region: str) -> Iterator[Image]:
    """Yield the images of FogROS2 in a region; '' for all regions."""
    for entry in account.pages(f'{account.project}/global/images', 'looking for images',
                               filter=f'labels.{TAG_BAKED}:*'):
        where, tags = entry.get('storageLocations', [''])[0], RULES.decode(entry['labels'])
        if region in ('', where):
            yield Image(
                f'gcp:{where}/{account.project}/{entry["name"]}', tags.get(TAG_BAKED, ''), 'gcp',
                where, created=when(entry.get('creationTimestamp')),
                size_gb=int(entry.get('diskSizeGb', 0)) or None,
                state=_STATES.get(entry['status'], entry['status'].lower()),
                dependencies=tags.get(TAG_DEPENDENCIES, ''), tags=tags)


def delete(account: Account, image_id: str) -> None:
    """
    Delete an image.

    :raises MachineNotFound: the id is not an image's.
    """
    parts = re.fullmatch(r'gcp:([a-z0-9-]*)/([a-z0-9.:-]+)/([a-z0-9-]+)', image_id)
    if parts is None:
        raise MachineNotFound(f"'{image_id}' is no image at Google", 'ros2 fog image list')
    path, what = f'{parts[2]}/global/images/{parts[3]}', f'deleting the image {parts[3]}'
    try:
        found: Mapping[str, Any] = account.call('GET', path, what)
    except GoogleError as error:
        if error.gone:
            return
        raise
    if TAG_BAKED not in found.get('labels', {}):
        raise ProviderError(f'{parts[3]} is no image of FogROS2',
                            'ros2 fog image list shows those that are')
    account.remove(path, what)
