# SPDX-License-Identifier: Apache-2.0
"""How a machine ends: the instance first, then what only it had, each seen to be gone."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, Optional

from fogros2.provider import TAG_NAME
from fogros2.provider.aws import instances, network
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError, code_of, GONE
from fogros2.provider.aws.instances import MachineId, TAG_ATTEMPT, TAG_MADE
from fogros2.waiting import wait_until

#: Seconds that an instance may take to end; usually it is half a minute.
PATIENCE = 300.0
#: Seconds after which a group without an instance gets none any more.
SETTLED = 900.0


def destroy(account: Account, machine: MachineId) -> None:
    """
    End an instance and everything that was made for it; returns when all is gone.

    What is gone already is no error, and what it left behind goes all the same. An instance that
    doesn't carry the machine's tag isn't touched.

    :raises FogError: something could not be deleted.
    """
    disks = account.disks.pop(machine.instance, set())
    # what this process has made is ours without asking
    if machine.instance in account.made or _there(account, machine, disks):
        if _terminate(account, machine):
            # it takes EC2 half a minute and more
            wait_until(
                lambda: not _there(account, machine, disks), timeout=PATIENCE, first=1.5,
                interval=3.0, longest=15.0, hint='ros2 fog delete again later',
                what=f'{machine.instance} in {machine.region} to be terminated')
    account.made.pop(machine.instance, None)
    account.doors.pop(machine.attempt, None)
    sweep(account, machine.region, machine.attempt, gone=disks)


def _terminate(account: Account, machine: MachineId) -> bool:
    """Have an instance end; returns whether there is something to wait for."""
    def ask() -> Optional[list[Mapping[str, Any]]]:
        try:
            return list(account.call(
                'ec2', machine.region, 'terminate_instances', f'ending {machine.instance}',
                InstanceIds=[machine.instance])['TerminatingInstances'])
        except AwsError as error:
            if code_of(error) not in GONE:
                raise
            # EC2 may not know one that was made a moment ago, and which would run on
            return None if account.just_made(machine.instance) else []

    told = wait_until(ask, timeout=PATIENCE, interval=1.0, longest=5.0,
                      what=f'{machine.instance} in {machine.region} to be known')
    return any(entry['CurrentState']['Name'] != 'terminated' for entry in told)


def _there(account: Account, machine: MachineId, disks: set[str]) -> bool:
    """Return whether an instance is there; adds the disks that go with it."""
    # by filters: unlike an id that EC2 has forgotten, what they don't find is no error
    found = instances.instances_in(account.call(
        'ec2', machine.region, 'describe_instances', f'watching {machine.instance} end',
        Filters=[{'Name': 'instance-id', 'Values': [machine.instance]},
                 *instances.tag_filters({TAG_ATTEMPT: machine.attempt})])['Reservations'])
    disks |= {disk for instance in found for disk in instances.own_disks(instance)}
    return any(instance['State']['Name'] != 'terminated' for instance in found)


def sweep(account: Account, region: str, attempt: str, gone: Collection[str] = ()) -> None:
    """
    Delete what an attempt made besides its instance: key, group, addresses, disks.

    :param gone: ids of what goes by itself, which EC2 tells of for some time.
    """
    drop_key(account, region, attempt)
    left = [str(entry['ResourceId']) for entry in account.pages(
        'ec2', region, 'describe_tags', 'Tags', 'looking for what is left',
        Filters=[{'Name': 'key', 'Values': [TAG_ATTEMPT]},
                 {'Name': 'value', 'Values': [attempt]}])]
    groups = [each for each in left if each.startswith('sg-')]
    if groups:
        network.delete_groups(account, region, groups, timeout=PATIENCE)
    else:
        # EC2 reports tags a little late: the name is certain
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
    """Delete the key of an attempt; there may be none."""
    account.remove(region, 'delete_key_pair', 'deleting the login key',
                  KeyName=instances.own_name(attempt))


def drop_groups(
    account: Account, region: str, attempt: str, *, known: Iterable[str] = (),
    timeout: float = PATIENCE,
) -> None:
    """
    Delete the group of an attempt, as soon as nothing uses it; there may be none.

    :param known: its id, which EC2 may not tell of yet where it was just made; () to look for it.
    """
    groups = list(known) or [
        str(group['GroupId']) for group in network.find_groups(account, region, attempt)]
    network.delete_groups(account, region, groups, timeout=timeout)


def end_instances(account: Account, region: str, attempt: str) -> None:
    """Have the instances of an attempt end, without waiting; there may be none."""
    found = instances.instances_in(account.call(
        'ec2', region, 'describe_instances', 'looking for what was made', Filters=[
            *instances.tag_filters({TAG_ATTEMPT: attempt}),
            {'Name': 'instance-state-name', 'Values': list(instances.ALIVE)}])['Reservations'])
    if found:
        account.remove(region, 'terminate_instances', 'ending what was made',
                      InstanceIds=[instance['InstanceId'] for instance in found])


def leftovers(account: Account, region: str, now: float) -> dict[str, str]:
    """
    Return attempts of which only a group or a key is left, and the names of their machines.

    A machine that ends by itself takes its disk and address along, but not these.

    :param now: seconds since the epoch; what was made just before may get its instance still.
    """
    ours = [{'Name': 'tag-key', 'Values': [TAG_ATTEMPT]}]
    entries = [
        *account.pages('ec2', region, 'describe_security_groups', 'SecurityGroups',
                       'looking for what is left', Filters=ours),
        *account.call('ec2', region, 'describe_key_pairs', 'looking for what is left',
                      Filters=ours)['KeyPairs']]
    tags = [instances.tags_of(entry) for entry in entries]
    left = {t[TAG_ATTEMPT]: t.get(TAG_NAME, '?') for t in tags
            if now - float(t.get(TAG_MADE, 0)) > SETTLED}
    if left:
        for instance in instances.instances_in(account.pages(
                'ec2', region, 'describe_instances', 'Reservations', 'looking for machines',
                Filters=[*ours, {'Name': 'instance-state-name',
                                 'Values': [*instances.ALIVE, 'shutting-down']}])):
            left.pop(instances.tags_of(instance)[TAG_ATTEMPT], None)
    return left
