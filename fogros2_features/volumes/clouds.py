# SPDX-License-Identifier: Apache-2.0
"""The disks of clouds of virtual machines as volumes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
from typing import Optional

from fogros2.model import Volume
from fogros2.provider import Attached
from fogros2.provider.vm.cloud import Disk, END_TIMEOUT
from fogros2.provider.vm.failures import wait_through
from fogros2.provider.vm.provider import disk_in_use, first_disk, VmProvider


class CloudVolumes:
    """The keeper of the disks of a cloud of virtual machines."""

    def __init__(self, provider: VmProvider) -> None:
        self._provider = provider

    def volumes(self, hosts: Sequence[str] = ()) -> Iterator[Volume]:
        """Yield the volumes of all regions."""
        for disk in self._disks():
            yield Volume(
                self._volume_id(disk), disk.name, self._provider.name, disk.zone or disk.region,
                disk.size_gb, disk.vm, self._provider.cloud.gb_month)

    def _disks(self) -> list[Disk]:
        cloud = self._provider.until()
        by_region = self._provider.everywhere(cloud, lambda region: list(cloud.disks(region)))
        return [disk for disks in by_region for disk in disks]

    def _volume_id(self, disk: Disk) -> str:
        return f'{self._provider.name}:{disk.region}/{disk.id}'

    def attach(self, machine_id: str, name: str, size_gb: int) -> Attached:
        """Attach the first volume of this name; two launches that make one keep the first."""
        machine = self._provider.vm_id(machine_id)
        cloud = self._provider.cloud.beside(machine).until(self._provider.cancel)
        made = '' if first_disk(cloud.disks(machine.region, name)) else cloud.make_disk(
            machine, name, size_gb)

        def look(attached: bool) -> Optional[Disk]:
            disks = list(cloud.disks(machine.region, name))
            disk = first_disk(disks)
            if disk is None:
                return None
            if made not in ('', disk.id):
                if any(one.id == made and not one.ready for one in disks):
                    return None  # EC2 deletes no disk that it still makes
                cloud.until(None).delete_disk(dataclasses.replace(disk, id=made))
                raise disk_in_use(disk)
            if disk.vm not in ('', machine.vm):
                raise disk_in_use(disk)
            return disk if disk.ready and (disk.vm or not attached) else None

        def wait(state: str) -> Disk:
            return wait_through(
                lambda: look(state == 'attached'), timeout=END_TIMEOUT,
                cancel=self._provider.cancel, first=0.3, interval=1.0, longest=3.0,
                what=f"the volume '{name}' to be {state}")

        devices = cloud.attach_disk(machine, wait('ready'))
        wait('attached')
        return Attached(devices)

    def detach(self, machine_id: str, name: str) -> None:
        """Detach all volumes of this name."""
        machine = self._provider.vm_id(machine_id)
        cloud = self._provider.cloud.beside(machine)
        for disk in cloud.disks(machine.region, name):
            if disk.vm == machine.vm:
                cloud.detach_disk(machine, disk)

    def delete_volume(self, volume_id: str) -> None:
        """Delete a disk that no machine has."""
        for disk in self._disks():
            if self._volume_id(disk) == volume_id:
                if disk.vm:
                    raise disk_in_use(disk)
                self._provider.cloud.delete_disk(disk)
