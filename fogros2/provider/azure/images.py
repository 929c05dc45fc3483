# SPDX-License-Identifier: Apache-2.0
"""
Images of machines, each in a Compute Gallery with a resource group of its own.

cloud-init treats a new machine's id as a first boot, so no machine is 'generalized' before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import secrets
import time
from typing import Any

from fogros2.errors import FogError
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.azure.account import Account
from fogros2.provider.azure.machines import region_of
from fogros2.provider.azure.options import Options
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import made_at, TAG_BAKED, TAG_MADE, TAG_USER, VmCloud, VmId
from fogros2.provider.vm.failures import unless_gone
from fogros2.provider.vm.images import check_baked, Image, image_parts, image_tags

#: Tag of an image's group with what its machines need to have.
TAG_KIND = 'fogros2-kind'
_STATES = {'Succeeded': 'available', 'Failed': 'failed'}
_COMPUTE = 'providers/Microsoft.Compute'


def _version(account: Account, group: str) -> str:
    # a gallery's name has no hyphen
    return account.path(group, f'{_COMPUTE}/galleries/{group.replace("-", "_")}/images/machine/'
                               'versions/1.0.0')


def bake(
    account: Account, machine: VmId, entry: Mapping[str, Any], kind: MachineType,
    generation: str, name: str, dependencies: str,
) -> str:
    """
    Make an image of a running machine, and return its id; the last step takes minutes.

    :param entry: the machine as Azure describes it.
    """
    region, group = machine.region, f'fogros2-image-{secrets.token_hex(6)}'
    tags = {**image_tags(name, entry['tags'], dependencies), TAG_MADE: str(int(time.time())),
            TAG_KIND: f'{kind.arch} {generation}'}
    version = _version(account, group)
    definition, gallery = version.rsplit('/', 2)[0], version.rsplit('/', 4)[0]
    snapshot = account.path(group, f'{_COMPUTE}/snapshots/machine')
    disk = entry['properties']['storageProfile']['osDisk']['managedDisk']['id']
    steps: list[tuple[str, dict[str, Any]]] = [
        (account.path(group), {}),
        (snapshot, {'incremental': True, 'creationData': {
            'createOption': 'Copy', 'sourceResourceId': disk}}),
        (gallery, {}),
        (definition, {
            'osType': 'Linux', 'osState': 'Generalized', 'hyperVGeneration': generation,
            'architecture': 'Arm64' if kind.arch == 'arm64' else 'x64',
            'identifier': {'publisher': 'fogros2', 'offer': 'machine', 'sku': group}}),
        (version, {'publishingProfile': {'targetRegions': [{'name': region}]},
                   'storageProfile': {'osDiskImage': {'source': {'id': snapshot}}}})]
    try:
        for path, properties in steps:
            account.call('PUT', path, f"making the image '{name}'",
                         {'location': region, 'tags': tags, 'properties': properties},
                         wait=path is not version)
    except FogError:
        account.delete(account.path(group), f"deleting the rest of the image '{name}'")
        raise
    return f'azure:{region}/{group}'


def _groups(account: Account, region: str, query: str) -> list[Mapping[str, Any]]:
    return [group for group in account.pages(
                account.path(rest='resourceGroups'), 'looking for images', **{'$filter': query})
            if TAG_BAKED in (group.get('tags') or {}) and region in ('', region_of(group))
            and group['properties']['provisioningState'] != 'Deleting']


def _state(account: Account, group: str) -> str:
    with unless_gone():
        version = account.call('GET', _version(account, group), f'looking for the image {group}')
        return _STATES.get(version['properties']['provisioningState'], 'pending')
    return 'failed'


def baked(
    account: Account, region: str, options: Options, dependencies: str,
) -> dict[tuple[str, str], str]:
    """Return the newest images with the same dependencies, by architecture and generation."""
    versions: dict[tuple[str, str], str] = {}
    if options.image or not dependencies:
        return versions
    groups = _groups(account, region,
                     f"tagName eq '{TAG_DEPENDENCIES}' and tagValue eq '{dependencies}'")
    for group in sorted(groups, key=lambda one: str(one['tags'].get(TAG_MADE, ''))):
        arch, _, generation = group['tags'].get(TAG_KIND, '').partition(' ')
        if group['tags'].get(TAG_DEPENDENCIES) == dependencies \
                and group['tags'].get(TAG_USER, options.user) == options.user \
                and _state(account, str(group['name'])) == 'available':
            versions[arch, generation] = _version(account, str(group['name']))
    return versions


class AzureImages(VmCloud):
    """The part of Azure that makes images of machines."""

    _account: Account

    def images(self, region: str) -> Iterator[Image]:
        for group in _groups(self._account, region, f"tagName eq '{TAG_BAKED}'"):
            tags, name = group['tags'], str(group['name'])
            yield Image(
                f'azure:{region_of(group)}/{name}', tags[TAG_BAKED], 'azure', region_of(group),
                created=made_at(tags) or None, state=_state(self._account, name),
                dependencies=tags.get(TAG_DEPENDENCIES, ''), tags=tags)

    def delete_image(self, image_id: str) -> None:
        _, group = image_parts(image_id, 'azure:([a-z0-9]+)/(fogros2-image-[0-9a-f]{12})')
        path, what = self._account.path(group), f'deleting the image {group}'
        with unless_gone():
            check_baked(self._account.call('GET', path, what).get('tags') or {}, group)
            self._account.delete(path, what, wait=True)
