# SPDX-License-Identifier: Apache-2.0
"""
Images of machines, each in a Compute Gallery with a resource group of its own.

cloud-init treats a new machine's id as a first boot, so no machine is 'generalized' before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import secrets
from typing import Any

from fogros2.errors import FogError
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.azure.machines import region_of
from fogros2.provider.azure.options import Options
from fogros2.provider.azure.prices import AzurePrices, generation, is_in, machine_type
from fogros2.provider.vm.cloud import made_at, TAG_BAKED, TAG_DISK, TAG_MADE, TAG_USER, VmId
from fogros2.provider.vm.failures import unless_gone
from fogros2.provider.vm.images import check_baked, Image, image_parts, image_tags

#: Tag of an image's group with what its machines need to have.
TAG_KIND = 'fogros2-kind'
_STATES = {'Succeeded': 'available', 'Failed': 'failed'}
_COMPUTE = 'providers/Microsoft.Compute'


class AzureImages(AzurePrices):
    """The part of Azure that makes images of machines."""

    def _entry(self, vm: str) -> Mapping[str, Any]:
        entry: Mapping[str, Any] = self._account.call(
            'GET', self._account.vm(vm), f'looking for {vm}', query={'$expand': 'instanceView'})
        return entry

    def _version(self, group: str) -> str:
        # a gallery's name has no hyphen
        return self._account.path(
            group, f'{_COMPUTE}/galleries/{group.replace("-", "_")}/images/machine/versions/1.0.0')

    def bake(self, machine: VmId, name: str, dependencies: str) -> str:
        """Make an image of a running machine, and return its id; the last step takes minutes."""
        entry, region = self._entry(machine.vm), machine.region
        size = self.sizes(region)[entry['properties']['hardwareProfile']['vmSize']]
        kind, made_for = machine_type(size), generation(size)
        group = f'fogros2-image-{secrets.token_hex(6)}'
        made = str(int(self._account.clock.now()))
        tags = {**image_tags(name, entry['tags'], dependencies), TAG_MADE: made,
                TAG_KIND: f'{kind.arch} {made_for}'}
        system_disk = entry['properties']['storageProfile']['osDisk']
        # Azure reports no size of a machine that does not run
        tags[TAG_DISK] = str(system_disk.get('diskSizeGB') or entry['tags'].get(TAG_DISK, '0'))
        path, version = self._account.path, self._version(group)
        definition, gallery = version.rsplit('/', 2)[0], version.rsplit('/', 4)[0]
        snapshot = path(group, f'{_COMPUTE}/snapshots/machine')
        steps: list[tuple[str, dict[str, Any]]] = [
            (path(group), {}),
            (snapshot, {'incremental': True, 'creationData': {
                'createOption': 'Copy', 'sourceResourceId': system_disk['managedDisk']['id']}}),
            (gallery, {}),
            (definition, {
                'osType': 'Linux', 'osState': 'Generalized', 'hyperVGeneration': made_for,
                'architecture': 'Arm64' if kind.arch == 'arm64' else 'x64',
                # without it, sizes whose disks are NVMe alone refuse the image
                **({'features': [{'name': 'DiskControllerTypes', 'value': 'SCSI, NVMe'}]}
                   if made_for == 'V2' else {}),
                'identifier': {'publisher': 'fogros2', 'offer': 'machine', 'sku': group}}),
            (version, {'publishingProfile': {'targetRegions': [{'name': region}]},
                       'storageProfile': {'osDiskImage': {'source': {'id': snapshot}}}})]
        try:
            for step, properties in steps:
                self._account.call('PUT', step, f"making the image '{name}'",
                                   {'location': region, 'tags': tags, 'properties': properties},
                                   wait=step is not version)
        except FogError:
            self._account.delete(path(group), f"deleting the rest of the image '{name}'")
            raise
        return f'azure:{region}/{group}'

    def _image_groups(self, region: str, query: str) -> list[Mapping[str, Any]]:
        return [group for group in self._account.pages(
                    self._account.path(rest='resourceGroups'), 'looking for images',
                    **{'$filter': query})
                if TAG_BAKED in (group.get('tags') or {}) and is_in(group, region)
                and group['properties']['provisioningState'] != 'Deleting']

    def _state(self, group: str) -> str:
        with unless_gone():
            version = self._account.call(
                'GET', self._version(group), f'looking for the image {group}')
            return _STATES.get(version['properties']['provisioningState'], 'pending')
        return 'failed'

    def baked(
        self, region: str, options: Options, dependencies: str,
    ) -> dict[tuple[str, str], tuple[str, int]]:
        """
        Return the newest images with the same dependencies, by architecture and generation.

        :returns: the path of each and the GB of its disk.
        """
        versions: dict[tuple[str, str], tuple[str, int]] = {}
        if options.image or not dependencies:
            return versions
        groups = self._image_groups(
            region, f"tagName eq '{TAG_DEPENDENCIES}' and tagValue eq '{dependencies}'")
        for group in sorted(groups, key=lambda one: made_at(one['tags']) or 0.0):
            arch, _, made_for = group['tags'].get(TAG_KIND, '').partition(' ')
            if group['tags'].get(TAG_DEPENDENCIES) == dependencies \
                    and group['tags'].get(TAG_USER, options.user) == options.user \
                    and self._state(str(group['name'])) == 'available':
                disk = str(group['tags'].get(TAG_DISK, ''))
                versions[arch, made_for] = (self._version(str(group['name'])),
                                            int(disk) if disk.isdecimal() else 0)
        return versions

    def images(self, region: str) -> Iterator[Image]:
        for group in self._image_groups(region, f"tagName eq '{TAG_BAKED}'"):
            tags, name = group['tags'], str(group['name'])
            yield Image(
                f'azure:{region_of(group)}/{name}', tags[TAG_BAKED], 'azure', region_of(group),
                created=made_at(tags) or None, state=self._state(name),
                dependencies=tags.get(TAG_DEPENDENCIES, ''), tags=tags)

    def delete_image(self, image_id: str) -> None:
        _, group = image_parts(image_id, 'azure:([a-z0-9]+)/(fogros2-image-[0-9a-f]{12})')
        path, what = self._account.path(group), f'deleting the image {group}'
        with unless_gone():
            check_baked(self._account.call('GET', path, what).get('tags') or {}, group)
            self._account.delete(path, what, wait=True)
