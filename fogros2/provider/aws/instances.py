# SPDX-License-Identifier: Apache-2.0
"""Instances in EC2's words and in ours: ids, tags, requests, states. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import datetime
from decimal import Decimal, InvalidOperation
import hashlib
import re
from typing import Any, NamedTuple, Optional
import uuid

from fogros2.errors import MachineNotFound
from fogros2.model import CreateRequest, Endpoint, Machine, MachineSpec, MachineState
from fogros2.provider import TAG_DEPENDENCIES, TAG_NAME
from fogros2.provider.aws.options import Options
from fogros2.provider.aws.user_data import END_COMMAND

PROVIDER = 'aws'
#: Of each machine's own: binds instance, volume, interface, group and key to one attempt.
TAG_ATTEMPT = 'fogros2-attempt'
TAG_HOST_KEY = 'fogros2-host-key'
TAG_USER = 'fogros2-user'
TAG_DISK = 'fogros2-disk-gb'
TAG_PRICE = 'fogros2-price-per-hour'
TAG_SSH_FROM = 'fogros2-ssh-from'
#: On groups and keys alone: seconds since the epoch at which they were made.
TAG_MADE = 'fogros2-made'

STATES = {
    'pending': MachineState.PENDING,
    'running': MachineState.RUNNING,
    'stopping': MachineState.STOPPING,
    'stopped': MachineState.STOPPED,
    # it can't come back, and isn't billed any more
    'shutting-down': MachineState.DELETED,
    'terminated': MachineState.DELETED,
}
#: EC2's states of machines that are there.
ALIVE = ('pending', 'running', 'stopping', 'stopped')
#: How EC2 says when an instance was stopped.
_STOPPED = re.compile(r'\((\d{4}-\d\d-\d\d \d\d:\d\d:\d\d) (?:GMT|UTC)\)')
#: After the type of a spot instance, for people to read.
_SPOT = ' spot'
_ID = re.compile(r'aws:([a-z0-9-]+)/(i-[0-9a-f]+)/([0-9a-f]{16})')


class MachineId(NamedTuple):
    """Where an instance is, which, and by which attempt it was made."""

    region: str
    instance: str
    attempt: str

    def __str__(self) -> str:
        return f'aws:{self.region}/{self.instance}/{self.attempt}'

    @classmethod
    def parse(cls, text: str) -> MachineId:
        """
        Return the parts of an id.

        :raises MachineNotFound: it is none of ours.
        """
        found = _ID.fullmatch(text)
        if found is None:
            raise MachineNotFound(f"'{text}' is no machine at AWS")
        return cls(*found.groups())


class Place(NamedTuple):
    """One try to get a machine: in which region, of which type, in which subnet ('': any)."""

    region: str
    kind: str
    subnet: str = ''


def attempt_of(token: str) -> str:
    """Return what an attempt is called in names and tags, which don't tell its token."""
    return hashlib.sha256(b'fogros2 attempt\0' + token.encode()).hexdigest()[:16]


def own_name(attempt: str) -> str:
    """Return what the group and the key of an attempt are called."""
    return f'fogros2-{attempt}'


def client_token(token: str, place: Place) -> str:
    """
    Return the token of one try; the same for the same try.

    EC2 takes a token's second use with other parameters for a mistake, so each place has its own.
    """
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f'fogros2:{token}:{"/".join(place)}'))


def own_tags(
    spec: MachineSpec, request: CreateRequest, options: Options, **more: str,
) -> dict[str, str]:
    """Return the tags of everything that is made for a machine."""
    tags = {**options.tags, 'Name': spec.name, **request.tags, TAG_NAME: spec.name,
            TAG_ATTEMPT: attempt_of(request.token), TAG_USER: options.user}
    if request.dependencies:
        tags[TAG_DEPENDENCIES] = request.dependencies
    if options.ssh_from:
        tags[TAG_SSH_FROM] = ' '.join(options.ssh_from)
    return {key: value for key, value in {**tags, **more}.items() if value}


def tag_list(tags: Mapping[str, str]) -> list[dict[str, str]]:
    """Return tags as EC2 takes them."""
    return [{'Key': key, 'Value': value} for key, value in tags.items()]


def tags_of(entry: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of what EC2 describes."""
    return {str(tag['Key']): str(tag['Value']) for tag in entry.get('Tags') or ()}


def tag_filters(tags: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return filters for what is ours and carries all of ``tags``."""
    return [{'Name': 'tag-key', 'Values': [TAG_ATTEMPT]},
            *({'Name': f'tag:{key}', 'Values': [_literal(value)]} for key, value in tags.items())]


def _literal(text: str) -> str:
    r"""Return a filter's value that stands for itself: ``*``, ``?`` and ``\`` don't."""
    return re.sub(r'([*?\\])', r'\\\1', text)


def run_request(
    spec: MachineSpec, request: CreateRequest, options: Options, *, place: Place,
    image: Mapping[str, Any], group: str, tags: Mapping[str, str], user_data: bytes,
) -> dict[str, Any]:
    """
    Return the parameters of RunInstances for one try.

    :param image: as DescribeImages tells of it.
    :param group: id of the machine's own security group.
    """
    device = str(image.get('RootDeviceName') or '/dev/sda1')
    groups = [group, *options.security_groups]
    disk = max(options.disk_size, _root_size(image, device))
    words: dict[str, Any] = {
        'ImageId': image['ImageId'],
        'InstanceType': place.kind,
        'MinCount': 1,
        'MaxCount': 1,
        'ClientToken': client_token(request.token, place),
        'KeyName': own_name(tags[TAG_ATTEMPT]),
        'UserData': user_data,
        # EC2's default is to keep a machine that shuts itself down, and to bill its disk
        'InstanceInitiatedShutdownBehavior': at_shutdown(spec),
        'MetadataOptions': {'HttpTokens': 'required', 'HttpEndpoint': 'enabled',
                            'HttpPutResponseHopLimit': 1},
        'BlockDeviceMappings': [{'DeviceName': device, 'Ebs': {
            'VolumeSize': disk,
            'VolumeType': 'gp3', 'Encrypted': True, 'DeleteOnTermination': True}}],
        'TagSpecifications': [
            {'ResourceType': kind, 'Tags': tag_list({**tags, TAG_DISK: str(disk)})}
            for kind in ('instance', 'volume', 'network-interface',
                         *(('spot-instances-request',) if options.spot else ()))],
    }
    if place.subnet:
        words['NetworkInterfaces'] = [{
            'DeviceIndex': 0, 'SubnetId': place.subnet, 'Groups': groups,
            'AssociatePublicIpAddress': True, 'DeleteOnTermination': True}]
    else:
        words['SecurityGroupIds'] = groups
    if options.iam_instance_profile:
        key = 'Arn' if options.iam_instance_profile.startswith('arn:') else 'Name'
        words['IamInstanceProfile'] = {key: options.iam_instance_profile}
    if options.spot:
        words['InstanceMarketOptions'] = {'MarketType': 'spot', 'SpotOptions': {
            'SpotInstanceType': 'one-time', 'InstanceInterruptionBehavior': 'terminate',
            **({'MaxPrice': str(options.max_price)} if options.max_price is not None else {})}}
    return words


def at_shutdown(spec: MachineSpec) -> str:
    """Return what becomes of an instance that shuts itself down, in EC2's word."""
    return 'stop' if spec.on_exit == 'stop' else 'terminate'


def is_spot(machine: Machine) -> bool:
    """Return whether AWS may take a machine back."""
    return machine.kind.endswith(_SPOT)


def _root_size(image: Mapping[str, Any], device: str) -> int:
    """Return how large (GB) an image's own disk is: a machine's can't be smaller."""
    return max((int(mapping.get('Ebs', {}).get('VolumeSize') or 0)
                for mapping in image.get('BlockDeviceMappings') or ()
                if mapping.get('DeviceName') == device), default=0)


def machine_id(region: str, instance: Mapping[str, Any]) -> str:
    """Return our id of an instance as EC2 describes it."""
    return str(MachineId(region, instance['InstanceId'],
                         tags_of(instance).get(TAG_ATTEMPT, '0' * 16)))


def machine_of(region: str, instance: Mapping[str, Any]) -> Machine:
    """Return an instance as EC2 describes it in our words."""
    tags = tags_of(instance)
    state = STATES.get(instance['State']['Name'], MachineState.PENDING)
    public = address_of(instance)
    key = tags.get(TAG_HOST_KEY)
    shell = None
    if state is MachineState.RUNNING and public and key:
        shell = Endpoint('ssh', public, user=tags.get(TAG_USER, 'ubuntu'), host_key=key)
    launched = instance.get('LaunchTime')
    kind = str(instance.get('InstanceType', ''))
    return Machine(
        machine_id(region, instance), tags.get(TAG_NAME, ''), PROVIDER, state,
        created=launched.timestamp() if launched is not None else None, shell=shell,
        vpn_host=public if state is MachineState.RUNNING else '',
        inner_network=f'aws:{instance["VpcId"]}' if instance.get('VpcId') else '',
        inner_host=str(instance.get('PrivateIpAddress') or ''), place=region,
        kind=f'{kind}{_SPOT}' if instance.get('InstanceLifecycle') == 'spot' else kind,
        image=str(instance.get('ImageId', '')), key=str(instance.get('KeyName', '')),
        disk_gb=int(disk) if (disk := tags.get(TAG_DISK, '')).isdigit() else None,
        tags=tags, end_command=END_COMMAND,
        cost_per_hour=_price(tags.get(TAG_PRICE, '')),
        stopped=_stopped(instance) if state is MachineState.STOPPED else None)


def address_of(instance: Mapping[str, Any]) -> str:
    """
    Return the address at which a robot reaches an instance, '' while it has none.

    One without a public address is reached at its private one, by a way that the user has made.
    """
    for interface in instance.get('NetworkInterfaces') or ():
        for address in interface.get('Ipv6Addresses') or ():
            if not instance.get('PublicIpAddress'):
                return str(address['Ipv6Address'])
    return str(instance.get('PublicIpAddress') or instance.get('PrivateIpAddress') or '')


def own_disks(instance: Mapping[str, Any]) -> set[str]:
    """Return the ids of the disks that go with an instance."""
    return {str(mapping['Ebs']['VolumeId'])
            for mapping in instance.get('BlockDeviceMappings') or ()
            if mapping.get('Ebs', {}).get('DeleteOnTermination')}


def reason_of(instance: Mapping[str, Any]) -> str:
    """Return why an instance ended, in EC2's words."""
    reason = instance.get('StateReason') or {}
    words = [str(reason.get('Message') or ''), str(reason.get('Code') or '')]
    return next((word for word in words if word), str(instance.get('StateTransitionReason') or ''))


def instances_in(reservations: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the instances in an answer of DescribeInstances."""
    return [instance for entry in reservations for instance in entry['Instances']]


def _stopped(instance: Mapping[str, Any]) -> Optional[float]:
    found = _STOPPED.search(str(instance.get('StateTransitionReason') or ''))
    if found is None:
        return None
    when = datetime.datetime.strptime(found[1], '%Y-%m-%d %H:%M:%S')
    return when.replace(tzinfo=datetime.timezone.utc).timestamp()


def _price(text: str) -> Optional[Decimal]:
    try:
        return Decimal(text)
    except InvalidOperation:
        return None
