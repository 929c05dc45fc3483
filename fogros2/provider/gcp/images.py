# SPDX-License-Identifier: Apache-2.0
"""Choose the image that a machine starts from; bake, list and delete images of machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import re
import time
from typing import Any

from fogros2.errors import ConfigurationError
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.gcp.account import Account
from fogros2.provider.gcp.instances import path_of, RULES
from fogros2.provider.gcp.options import Options
from fogros2.provider.vm.cloud import TAG_BAKED, TAG_DRIVER, TAG_USER, VmCloud, VmId, when
from fogros2.provider.vm.failures import unless_gone
from fogros2.provider.vm.images import check_baked, Image, image_parts, image_tags

#: Families of images, by architecture; ROS 2 Jazzy is for Ubuntu 24.04.
UBUNTU = 'projects/ubuntu-os-cloud/global/images/family/ubuntu-2404-lts-'
#: The same with NVIDIA's driver in it.
ACCELERATED = 'projects/ubuntu-os-accelerator-images/global/images/family/' \
    'ubuntu-accelerator-2404-{}-with-nvidia-580'
_STATES = {'READY': 'available', 'DELETING': 'deleted'}
_ARCHES = {'x86_64': 'amd64', 'arm64': 'arm64'}


class GoogleImages(VmCloud):
    """The part of Compute Engine that chooses images of types, and makes images of machines."""

    _account: Account

    def image_for(
        self, options: Options, arch: str, gpus: bool, dependencies: str,
    ) -> tuple[str, int]:
        """
        Return the path of the image that a machine starts from, and the size of its disk in GB.

        :raises ConfigurationError: the image does not exist, or is for another processor.
        """
        if options.ami_image:
            return self._named(options.ami_image, arch)
        project = self._account.project
        fitting = [image for image in self._account.pages(
            f'{project}/global/images', 'looking for images baked before',
            filter=f'(labels.{TAG_BAKED}:*) (labels.{TAG_DEPENDENCIES} = "{dependencies}")')
            if image['status'] == 'READY'
            and image.get('architecture', 'X86_64').lower() == arch
            and image['labels'].get(TAG_USER) == RULES.encode({'': options.user})['']
            and (TAG_DRIVER in image['labels']) is gpus
        ] if dependencies else []
        if fitting:
            newest = max(fitting, key=lambda image: when(image['creationTimestamp']) or 0.0)
            return (f'projects/{project}/global/images/{newest["name"]}',
                    int(newest['diskSizeGb']))
        return (ACCELERATED.format(_ARCHES[arch]) if gpus else f'{UBUNTU}{_ARCHES[arch]}'), 10

    def _named(self, name: str, arch: str) -> tuple[str, int]:
        short = name.removeprefix('global/images/')
        path = name if name.startswith('projects/') \
            else f'projects/{self._account.project}/global/images/{short}'
        image: Mapping[str, Any] = {}
        with unless_gone():
            image = self._account.call('GET', path.removeprefix('projects/'),
                                       f'looking for the image {name}')
        if not image:
            raise ConfigurationError(f"there is no image '{name}'",
                                     'leave ami_image= out for Ubuntu 24.04')
        if image.get('architecture', arch).lower() != arch:
            raise ConfigurationError(
                f"the image '{name}' is for {image['architecture']} processors, and the machine "
                f'has {arch}', 'another machine_type=, or leave ami_image= out')
        return path, int(image.get('diskSizeGb', 10))

    def bake(self, machine: VmId, name: str, dependencies: str) -> str:
        vm = self.get(machine.region, machine.vm)
        assert vm is not None
        project, zone, instance = vm.id.split('/')
        what = f"making the image '{name}'"
        gpus = any(kind.gpus for kind in self.named_types(vm.region, [vm.kind])) or bool(
            self._account.call('GET', path_of(vm.id), what).get('guestAccelerators'))
        stamp = time.strftime('%Y%m%d-%H%M%S', time.gmtime())
        plain = re.sub('[^a-z0-9-]', '-', name.lower())[:36]
        own = f'fogros2-{plain}-{stamp}'
        self._account.call(
            'POST', f'{project}/global/images', what, forceCreate='true',
            body={'name': own, 'sourceDisk': f'projects/{project}/zones/{zone}/disks/{instance}',
                  'labels': RULES.encode(image_tags(
                      name, vm.tags, dependencies, nvidia=gpus)),
                  'storageLocations': [vm.region]})
        return f'gcp:{vm.region}/{project}/{own}'

    def images(self, region: str) -> Iterator[Image]:
        project = self._account.project
        for entry in self._account.pages(f'{project}/global/images', 'looking for images',
                                         filter=f'labels.{TAG_BAKED}:*'):
            where, tags = entry.get('storageLocations', [''])[0], RULES.decode(entry['labels'])
            if region in ('', where):
                yield Image(
                    f'gcp:{where}/{project}/{entry["name"]}', tags.get(TAG_BAKED, ''), 'gcp',
                    where, created=when(entry.get('creationTimestamp')),
                    size_gb=int(entry.get('diskSizeGb', 0)) or None,
                    state=_STATES.get(entry['status'], entry['status'].lower()),
                    dependencies=tags.get(TAG_DEPENDENCIES, ''), tags=tags)

    def delete_image(self, image_id: str) -> None:
        _, project, name = image_parts(
            image_id, r'gcp:([a-z0-9-]*)/([a-z0-9.:-]+)/([a-z0-9-]+)')
        path, what = f'{project}/global/images/{name}', f'deleting the image {name}'
        with unless_gone():
            check_baked(self._account.call('GET', path, what).get('labels', {}), name)
            self._account.remove(path, what)
