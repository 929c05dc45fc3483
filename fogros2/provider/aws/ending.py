# SPDX-License-Identifier: Apache-2.0
"""Delete a machine: the instance first, then its group, key, addresses and disks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, Optional

from fogros2.provider.aws import instances
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.aws.network import Ec2Network
from fogros2.provider.vm.cloud import TAG_ATTEMPT, VmId
from fogros2.waiting import wait_until

#: Time-out in seconds for the end of an instance; usually it takes half a minute.
TIMEOUT = 300.0


class Ec2Endings(Ec2Network):
    """The part of EC2 that deletes machines; an instance without the machine's tag stays."""

    def delete(self, machine: VmId) -> None:
        # no look-up is needed for what this process has created
        if (machine.vm in self._account.made or self._there(machine)) \
                and self._terminate(machine):
            wait_until(
                lambda: not self._there(machine), timeout=TIMEOUT, first=1.5, interval=3.0,
                longest=15.0, hint='ros2 fog delete again later',
                what=f'{machine.vm} in {machine.region} to be terminated')
        self._account.made.pop(machine.vm, None)
        self._account.doors.pop(machine.attempt, None)
        # EC2 reports these for a while, although they are being deleted
        gone = self._account.disks.pop(machine.vm, set())
        self.sweep(machine.region, machine.attempt, gone=gone)

    def _terminate(self, machine: VmId) -> bool:
        """Terminate an instance; return whether its end has to be awaited."""
        def ask() -> Optional[list[Mapping[str, Any]]]:
            try:
                return list(self._account.call(
                    'ec2', machine.region, 'terminate_instances', f'ending {machine.vm}',
                    InstanceIds=[machine.vm])['TerminatingInstances'])
            except AwsError as error:
                if not error.gone:
                    raise
                # EC2 may not report a new instance yet, which would continue to run
                return None if self._account.just_made(machine.vm) else []

        told = wait_until(ask, timeout=TIMEOUT, interval=1.0, longest=5.0,
                          what=f'{machine.vm} in {machine.region} to be known')
        return any(entry['CurrentState']['Name'] != 'terminated' for entry in told)

    def _there(self, machine: VmId) -> bool:
        # filters: an id that EC2 does not know would be an error
        found = self._instances(
            machine.region, {TAG_ATTEMPT: machine.attempt}, f'watching {machine.vm} end',
            {'Name': 'instance-id', 'Values': [machine.vm]})
        for instance in found:
            self._account.disks.setdefault(machine.vm, set()).update(
                instances.own_disks(instance))
        return any(instance['State']['Name'] != 'terminated' for instance in found)

    def _instances(
        self, region: str, tags: Mapping[str, str], what: str, *filters: Mapping[str, Any],
    ) -> list[Mapping[str, Any]]:
        """Return the instances of FogROS2 with all of ``tags``, in EC2's form."""
        return instances.instances_in(self._account.pages(
            'ec2', region, 'describe_instances', 'Reservations', what,
            Filters=[*instances.tag_filters(tags), *filters]))

    def sweep(self, region: str, attempt: str, *, gone: Collection[str] = ()) -> None:
        account = self._account
        self._drop_key(region, attempt)
        left = [str(entry['ResourceId']) for entry in account.pages(
            'ec2', region, 'describe_tags', 'Tags', 'looking for what is left',
            Filters=[{'Name': 'key', 'Values': [TAG_ATTEMPT]},
                     {'Name': 'value', 'Values': [attempt]}])]
        # EC2 reports tags a little late; the group's name is reliable
        self._drop_groups(region, attempt, [each for each in left if each.startswith('sg-')],
                          timeout=TIMEOUT)
        for address in left:
            if address.startswith('eipalloc-'):
                account.remove(region, 'release_address', 'releasing an address',
                               AllocationId=address)
        found: Iterable[Mapping[str, Any]] = account.call(
            'ec2', region, 'describe_volumes', 'looking for disks',
            Filters=[{'Name': f'tag:{TAG_ATTEMPT}', 'Values': [attempt]},
                     {'Name': 'status', 'Values': ['available', 'error']}],
        )['Volumes'] if any(each.startswith('vol-') and each not in gone for each in left) else ()
        for disk in found:
            account.remove(region, 'delete_volume', 'deleting a disk', VolumeId=disk['VolumeId'])

    def end_attempt(self, region: str, attempt: str) -> None:
        found = self._instances(region, {TAG_ATTEMPT: attempt}, 'looking for what was made',
                                instances.in_states(instances.ALIVE))
        if found:
            self._account.remove(region, 'terminate_instances', 'ending what was made',
                                 InstanceIds=[instance['InstanceId'] for instance in found])

    def remains(self, region: str) -> list[dict[str, str]]:
        # the end of a machine deletes its disk and address, but not its group and key
        entries = [
            *self._account.pages('ec2', region, 'describe_security_groups', 'SecurityGroups',
                                 'looking for what is left', Filters=instances.tag_filters({})),
            *self._account.call('ec2', region, 'describe_key_pairs', 'looking for what is left',
                                Filters=instances.tag_filters({}))['KeyPairs']]
        return [instances.tags_of(entry) for entry in entries]

    def attempts(self, region: str) -> list[str]:
        return [instances.tags_of(found)[TAG_ATTEMPT] for found in self._instances(
            region, {}, 'looking for machines',
            instances.in_states([*instances.ALIVE, 'shutting-down']))]
