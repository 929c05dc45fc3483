# SPDX-License-Identifier: Apache-2.0
"""
Disks of Azure that outlive machines, in a resource group of their own.

The group stays without disks: another launch may be about to make one in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from decimal import Decimal
from typing import Any

from fogros2.provider.azure.account import Account
from fogros2.provider.azure.prices import is_in
from fogros2.provider.vm.cloud import Disk, TAG_VOLUME, VmCloud, VmId, when

_DISKS = 'providers/Microsoft.Compute/disks'
_GROUP = 'fogros2-volumes'


class AzureDisks(VmCloud):
    """The part of Azure that has disks; they are in no zone, as the machines are."""

    _account: Account
    gb_month = Decimal('0.08')  # a standard SSD in eastus

    def disks(self, region: str, name: str = '') -> Iterator[Disk]:
        for entry in self._account.pages(self._account.path(rest=_DISKS), 'looking for volumes'):
            volume, properties = (entry.get('tags') or {}).get(TAG_VOLUME), entry['properties']
            state = properties.get('provisioningState')
            if volume and name in ('', volume) and is_in(entry, region) and state != 'Deleting':
                yield Disk(
                    str(entry['name']), volume, str(entry['location']), '',
                    int(properties['diskSizeGB']),
                    str(entry.get('managedBy') or '').rpartition('/')[2].lower(),
                    state == 'Succeeded', when(properties.get('timeCreated')) or 0.0)

    def make_disk(self, machine: VmId, name: str, size_gb: int) -> str:
        what, disk = f"making the volume '{name}'", f'{name}-{machine.region}'
        # two launches at once make one of this name
        self._account.call('PUT', self._account.path(_GROUP), what,
                           {'location': self._group_location(machine.region)})
        self._account.call('PUT', self._path(disk), what, {
            'location': machine.region, 'sku': {'name': 'StandardSSD_LRS'},
            'tags': {TAG_VOLUME: name},
            'properties': {'creationData': {'createOption': 'Empty'}, 'diskSizeGB': size_gb}})
        return disk

    def _group_location(self, region: str) -> str:
        """Return the region of the group, which disks of all regions share."""
        groups = self._account.pages(self._account.path(rest='resourceGroups'),
                                     'looking for the group of volumes')
        return next((str(group['location']) for group in groups
                     if str(group['name']).lower() == _GROUP), region)

    def attach_disk(self, machine: VmId, disk: Disk) -> tuple[str, ...]:
        attached = self._attached(machine)
        number = next((int(one['lun']) for one in attached if _has(one, disk)), None)
        if number is None:
            number = next(lun for lun in range(64) if lun not in [one['lun'] for one in attached])
            self._attach(machine, [*attached, {
                'lun': number, 'createOption': 'Attach', 'deleteOption': 'Detach',
                'managedDisk': {'id': self._path(disk.id)}}], f"attaching '{disk.name}'")
        # by SCSI, and by NVMe
        return f'/dev/disk/azure/scsi1/lun{number}', f'/dev/disk/azure/data/by-lun/{number}'

    def detach_disk(self, machine: VmId, disk: Disk) -> None:
        self._attach(machine, [one for one in self._attached(machine) if not _has(one, disk)],
                     f"detaching the volume '{disk.name}'")

    def _attached(self, machine: VmId) -> list[Mapping[str, Any]]:
        entry = self._account.call('GET', self._account.vm(machine.vm), f'looking at {machine.vm}')
        return list(entry['properties']['storageProfile'].get('dataDisks') or ())

    def _attach(self, machine: VmId, disks: list[Mapping[str, Any]], what: str) -> None:
        self._account.call('PATCH', self._account.vm(machine.vm), what, {
            'properties': {'storageProfile': {'dataDisks': disks}}}, wait=True)

    def delete_disk(self, disk: Disk) -> None:
        self._account.delete(self._path(disk.id), f"deleting the volume '{disk.name}'", wait=True)

    def _path(self, disk: str) -> str:
        return self._account.path(_GROUP, f'{_DISKS}/{disk}')


def _has(attached: Mapping[str, Any], disk: Disk) -> bool:
    return str(attached['managedDisk']['id']).lower().endswith(f'/disks/{disk.id}'.lower())
