# SPDX-License-Identifier: Apache-2.0
"""How a machine ends: the instance first, then what only it had, each seen to be gone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fogros2.provider.aws import instances, network
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.creation import drop_key
from fogros2.provider.aws.failures import AwsError, code_of, GONE
from fogros2.provider.aws.instances import MachineId, TAG_ATTEMPT
from fogros2.waiting import wait_until

#: Seconds that an instance may take to end; usually it is half a minute.
PATIENCE = 300.0


def destroy(account: Account, machine: MachineId) -> None:
    """
    End an instance and everything that was made for it; returns when all is gone.

    What is gone already is no error, and what it left behind goes all the same.

    :raises FogError: something could not be deleted.
    """
    if _terminate(account, machine):
        wait_until(
            lambda: not _there(account, machine), timeout=PATIENCE, interval=1.0, longest=5.0,
            what=f'{machine.instance} in {machine.region} to be terminated',
            hint='ros2 fog delete again later')
    sweep(account, machine.region, machine.attempt)


def _terminate(account: Account, machine: MachineId) -> bool:
    """Ask for the end; returns whether there is something to wait for."""
    try:
        answer = account.call('ec2', machine.region, 'terminate_instances',
                              f'ending {machine.instance}', InstanceIds=[machine.instance])
    except AwsError as error:
        if code_of(error) in GONE:
            return False
        raise
    return any(entry['CurrentState']['Name'] != 'terminated'
               for entry in answer['TerminatingInstances'])


def _there(account: Account, machine: MachineId) -> bool:
    try:
        found = instances.instances_in(account.call(
            'ec2', machine.region, 'describe_instances', f'watching {machine.instance} end',
            InstanceIds=[machine.instance])['Reservations'])
    except AwsError as error:
        if code_of(error) in GONE:
            return False
        raise
    return any(instance['State']['Name'] != 'terminated' for instance in found)


def sweep(account: Account, region: str, attempt: str) -> None:
    """Delete what an attempt made besides its instance: key, group, addresses, disks."""
    drop_key(account, region, attempt)
    network.delete_groups(
        account, region,
        [str(group['GroupId']) for group in network.find_groups(account, region, attempt)])
    mine = [{'Name': f'tag:{TAG_ATTEMPT}', 'Values': [attempt]}]
    for address in account.call('ec2', region, 'describe_addresses', 'looking for addresses',
                                Filters=mine)['Addresses']:
        _gone_is_fine(account, region, 'release_address', 'releasing an address',
                      AllocationId=address['AllocationId'])
    volumes: Iterable[Mapping[str, Any]] = account.call(
        'ec2', region, 'describe_volumes', 'looking for disks',
        Filters=[*mine, {'Name': 'status', 'Values': ['available', 'error']}])['Volumes']
    for volume in volumes:
        _gone_is_fine(account, region, 'delete_volume', 'deleting a disk',
                      VolumeId=volume['VolumeId'])


def _gone_is_fine(account: Account, region: str, operation: str, what: str, **words: Any) -> None:
    try:
        account.call('ec2', region, operation, what, **words)
    except AwsError as error:
        if code_of(error) not in GONE:
            raise
