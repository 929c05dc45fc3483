# SPDX-License-Identifier: Apache-2.0
"""Delete a machine: the instance first, then its group, key, addresses and disks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, Optional

from fogros2.provider.aws import instances, network
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.vm.cloud import own_name, TAG_ATTEMPT, VmId
from fogros2.waiting import wait_until

#: Time-out in seconds for the end of an instance; usually it takes half a minute.
TIMEOUT = 300.0


def destroy(account: Account, machine: VmId) -> None:
    """
    Delete an instance and everything that was created for it; return when all of it is gone.

    Idempotent. An instance without the machine's tag is not touched.

    :raises FogError: something could not be deleted.
    """
    disks = account.disks.pop(machine.vm, set())
    # no look-up is needed for what this process has created
    if machine.vm in account.made or _there(account, machine, disks):
        if _terminate(account, machine):
            wait_until(
                lambda: not _there(account, machine, disks), timeout=TIMEOUT, first=1.5,
                interval=3.0, longest=15.0, hint='ros2 fog delete again later',
                what=f'{machine.vm} in {machine.region} to be terminated')
    account.made.pop(machine.vm, None)
    account.doors.pop(machine.attempt, None)
    sweep(account, machine.region, machine.attempt, gone=disks)


def _terminate(account: Account, machine: VmId) -> bool:
    """Terminate an instance; return whether its end has to be awaited."""
    def ask() -> Optional[list[Mapping[str, Any]]]:
        try:
            return list(account.call(
                'ec2', machine.region, 'terminate_instances', f'ending {machine.vm}',
                InstanceIds=[machine.vm])['TerminatingInstances'])
        except AwsError as error:
            if not error.gone:
                raise
            # EC2 may not report a new instance yet, which would continue to run
            return None if account.just_made(machine.vm) else []

    told = wait_until(ask, timeout=TIMEOUT, interval=1.0, longest=5.0,
                      what=f'{machine.vm} in {machine.region} to be known')
    return any(entry['CurrentState']['Name'] != 'terminated' for entry in told)


def _there(account: Account, machine: VmId, disks: set[str]) -> bool:
    """Return whether an instance exists; add the disks that are deleted with it."""
    # filters: an id that EC2 does not know would be an error
    found = instances.instances_in(account.call(
        'ec2', machine.region, 'describe_instances', f'watching {machine.vm} end',
        Filters=[{'Name': 'instance-id', 'Values': [machine.vm]},
                 *instances.tag_filters({TAG_ATTEMPT: machine.attempt})])['Reservations'])
    disks |= {disk for instance in found for disk in instances.own_disks(instance)}
    return any(instance['State']['Name'] != 'terminated' for instance in found)


def sweep(account: Account, region: str, attempt: str, gone: Collection[str] = ()) -> None:
    """
    Delete what an attempt created besides its instance: key, group, addresses, disks.

    :param gone: ids that EC2 still reports although they are being deleted.
    """
    drop_key(account, region, attempt)
    left = [str(entry['ResourceId']) for entry in account.pages(
        'ec2', region, 'describe_tags', 'Tags', 'looking for what is left',
        Filters=[{'Name': 'key', 'Values': [TAG_ATTEMPT]},
                 {'Name': 'value', 'Values': [attempt]}])]
    groups = [each for each in left if each.startswith('sg-')]
    if groups:
        network.delete_groups(account, region, groups, timeout=TIMEOUT)
    else:
        # EC2 reports tags a little late; the name is reliable
        drop_groups(account, region, attempt)
    for address in left:
        if address.startswith('eipalloc-'):
            account.remove(region, 'release_address', 'releasing an address',
                          AllocationId=address)
    if any(each.startswith('vol-') and each not in gone for each in left):
        _drop_volumes(account, region, attempt)


def _drop_volumes(account: Account, region: str, attempt: str) -> None:
    volumes: Iterable[Mapping[str, Any]] = account.call(
        'ec2', region, 'describe_volumes', 'looking for disks',
        Filters=[{'Name': f'tag:{TAG_ATTEMPT}', 'Values': [attempt]},
                 {'Name': 'status', 'Values': ['available', 'error']}])['Volumes']
    for volume in volumes:
        account.remove(region, 'delete_volume', 'deleting a disk',
                      VolumeId=volume['VolumeId'])


def drop_key(account: Account, region: str, attempt: str) -> None:
    """Delete the key of an attempt, if it exists."""
    account.remove(region, 'delete_key_pair', 'deleting the login key',
                  KeyName=own_name(attempt))


def drop_groups(
    account: Account, region: str, attempt: str, *, known: Iterable[str] = (),
    timeout: float = TIMEOUT,
) -> None:
    """
    Delete the group of an attempt, if it exists, when no instance uses it.

    :param known: its id, which EC2 may not report yet if it is new; () to look for it.
    """
    groups = list(known) or [
        str(group['GroupId']) for group in network.find_groups(account, region, attempt)]
    network.delete_groups(account, region, groups, timeout=timeout)


def end_instances(account: Account, region: str, attempt: str) -> None:
    """Terminate the instances of an attempt without waiting."""
    found = instances.instances_in(account.call(
        'ec2', region, 'describe_instances', 'looking for what was made', Filters=[
            *instances.tag_filters({TAG_ATTEMPT: attempt}),
            {'Name': 'instance-state-name', 'Values': list(instances.ALIVE)}])['Reservations'])
    if found:
        account.remove(region, 'terminate_instances', 'ending what was made',
                      InstanceIds=[instance['InstanceId'] for instance in found])


def remains(account: Account, region: str) -> list[dict[str, str]]:
    """
    Return the tags of groups and keys.

    The end of a machine deletes its disk and address, but not these; see ``VmCloud.leftovers``.
    """
    entries = [
        *account.pages('ec2', region, 'describe_security_groups', 'SecurityGroups',
                       'looking for what is left', Filters=instances.tag_filters({})),
        *account.call('ec2', region, 'describe_key_pairs', 'looking for what is left',
                      Filters=instances.tag_filters({}))['KeyPairs']]
    return [instances.tags_of(entry) for entry in entries]


def attempts(account: Account, region: str) -> list[str]:
    """Return the attempts with an instance that EC2 has not terminated yet."""
    return [instances.tags_of(found)[TAG_ATTEMPT] for found in instances.instances_in(
        account.pages('ec2', region, 'describe_instances', 'Reservations', 'looking for machines',
                      Filters=[*instances.tag_filters({}), {
                          'Name': 'instance-state-name',
                          'Values': [*instances.ALIVE, 'shutting-down']}]))]
