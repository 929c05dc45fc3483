# SPDX-License-Identifier: Apache-2.0
"""Disks of Compute Engine that outlive machines, one of a name in each zone."""

from __future__ import annotations

from collections.abc import Iterator
import copy
from decimal import Decimal

from fogros2.provider.gcp import instances
from fogros2.provider.gcp.account import Account
from fogros2.provider.gcp.instances import path_of
from fogros2.provider.vm.cloud import Disk, TAG_VOLUME, VmCloud, VmId, when

#: Machines may have the right to delete what begins with 'fogros2-' (doc/gcp.md).
_PREFIX = 'volume-'


class GoogleDisks(VmCloud):
    """The part of Compute Engine that has disks."""

    _account: Account
    gb_month = Decimal('0.10')  # balanced, in us-central1

    def beside(self, machine: VmId) -> GoogleDisks:
        other = copy.copy(self)
        other._account = self._account.of_project(machine.vm.partition('/')[0])
        return other

    def disks(self, region: str, name: str = '') -> Iterator[Disk]:
        wanted = f'(labels.{TAG_VOLUME} = "{name}")' if name else f'(labels.{TAG_VOLUME}:*)'
        for entry in self._account.pages(f'{self._account.project}/aggregated/disks',
                                         'looking for volumes', filter=wanted):
            zone = str(entry['zone']).rpartition('/')[2]
            users = [str(user).split('/projects/')[-1].split('/') for user in
                     entry.get('users') or ()]
            if region in ('', zone[:-2]) and entry['status'] != 'DELETING':
                yield Disk(
                    f'{self._account.project}/{zone}/{entry["name"]}', entry['labels'][TAG_VOLUME],
                    zone[:-2], zone, int(entry['sizeGb']),
                    ''.join('/'.join(words[::2]) for words in users), entry['status'] == 'READY',
                    when(entry['creationTimestamp']) or 0.0)

    def make_disk(self, machine: VmId, name: str, size_gb: int) -> str:
        project, zone, vm = machine.vm.split('/')
        kind = str(self._account.call('GET', path_of(machine.vm),
                                      f'looking for {vm}')['machineType']).rpartition('/')[2]
        # two launches at once make one of this name
        self._account.create(
            f'{project}/zones/{zone}/disks', f"making the volume '{name}'", {
                'name': _PREFIX + name, 'sizeGb': str(size_gb),
                'type': f'projects/{project}/zones/{zone}/diskTypes/{instances.disk_type(kind)}',
                'labels': {TAG_VOLUME: name}})
        return f'{project}/{zone}/{_PREFIX}{name}'

    def attach_disk(self, machine: VmId, disk: Disk) -> tuple[str, ...]:
        project, zone, name = disk.id.split('/')
        if not disk.vm:
            self._account.run(
                'POST', f'{path_of(machine.vm)}/attachDisk', f"attaching the volume '{disk.name}'",
                body={'source': f'projects/{project}/zones/{zone}/disks/{name}',
                      'deviceName': name, 'autoDelete': False, 'mode': 'READ_WRITE'})
        return (f'/dev/disk/by-id/google-{name}',)

    def detach_disk(self, machine: VmId, disk: Disk) -> None:
        self._account.run(
            'POST', f'{path_of(machine.vm)}/detachDisk', f"detaching the volume '{disk.name}'",
            deviceName=disk.id.rpartition('/')[2])

    def delete_disk(self, disk: Disk) -> None:
        project, zone, name = disk.id.split('/')
        self._account.remove(f'{project}/zones/{zone}/disks/{name}',
                             f"deleting the volume '{disk.name}'")
