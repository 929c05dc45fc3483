# SPDX-License-Identifier: Apache-2.0
"""Requests and reports of EC2 instances, converted without any call; the preemption notice."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import re
from typing import Any, Optional

from fogros2.model import MachineSpec, MachineState
from fogros2.provider.aws.options import Options
from fogros2.provider.vm.cloud import Order, own_name, Place, TAG_ATTEMPT, TAG_DISK, Vm, when
from fogros2.provider.vm.metadata import ASK

STATES = {
    'pending': MachineState.PENDING,
    'running': MachineState.RUNNING,
    'stopping': MachineState.STOPPING,
    'stopped': MachineState.STOPPED,
    # it cannot return, and is not billed any more
    'shutting-down': MachineState.DELETED,
    'terminated': MachineState.DELETED,
}
#: EC2's states of instances that exist.
ALIVE = ('pending', 'running', 'stopping', 'stopped')
#: When an instance was stopped, in EC2's words.
_STOPPED = re.compile(r'\((\d{4}-\d\d-\d\d \d\d:\d\d:\d\d) (?:GMT|UTC)\)')

#: Runs every few seconds; its success is the notice, and its output has the time.
NOTICE = ('python3', '-ISc', ASK + """\
try:
    token = ask('/latest/api/token', 'X-aws-ec2-metadata-token-ttl-seconds: 60', 'PUT')
    print(ask('/latest/meta-data/spot/instance-action', 'X-aws-ec2-metadata-token: ' + token))
except OSError:
    sys.exit(1)
""")


def tag_list(tags: Mapping[str, str]) -> list[dict[str, str]]:
    """Convert tags to EC2's form."""
    return [{'Key': key, 'Value': value} for key, value in tags.items()]


def tags_of(entry: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of a resource."""
    return {str(tag['Key']): str(tag['Value']) for tag in entry.get('Tags') or ()}


def tag_filters(tags: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return filters for FogROS2's resources with all of ``tags``."""
    # a filter's value has * and ? as wildcards
    return [{'Name': 'tag-key', 'Values': [TAG_ATTEMPT]}, *(
        {'Name': f'tag:{key}', 'Values': [re.sub(r'([*?\\])', r'\\\1', value)]}
        for key, value in tags.items())]


def in_states(states: Iterable[str]) -> dict[str, Any]:
    """Return the filter for instances in these states."""
    return {'Name': 'instance-state-name', 'Values': list(states)}


def run_request(
    place: Place, order: Order, image: Mapping[str, Any], group: str, tags: Mapping[str, str],
) -> dict[str, Any]:
    """
    Return the parameters of RunInstances for one place.

    :param image: an entry of DescribeImages.
    :param group: id of the machine's own security group.
    """
    options: Options = order.options
    device = str(image.get('RootDeviceName') or '/dev/sda1')
    disk = max(options.disk_size, _root_size(image, device))
    words: dict[str, Any] = {
        'ImageId': image['ImageId'],
        'InstanceType': place.kind,
        'MinCount': 1,
        'MaxCount': 1,
        'ClientToken': order.token(place),
        'KeyName': own_name(order.attempt),
        'UserData': order.user_data,
        # EC2's default is to keep a machine that shuts itself down, and to bill its disk
        'InstanceInitiatedShutdownBehavior': at_shutdown(order.spec),
        'MetadataOptions': {'HttpTokens': 'required', 'HttpEndpoint': 'enabled',
                            'HttpPutResponseHopLimit': 1},
        'BlockDeviceMappings': [{'DeviceName': device, 'Ebs': {
            'VolumeSize': disk,
            'VolumeType': 'gp3', 'Encrypted': True, 'DeleteOnTermination': True}}],
        'TagSpecifications': [
            {'ResourceType': kind, 'Tags': tag_list({**tags, TAG_DISK: str(disk)})}
            for kind in ('instance', 'volume', 'network-interface',
                         *(('spot-instances-request',) if options.spot else ()))],
        # without a subnet, EC2 chooses a default one, which may give no public addresses itself
        'NetworkInterfaces': [{
            'DeviceIndex': 0, 'Groups': [group], 'AssociatePublicIpAddress': True,
            'DeleteOnTermination': True, **({'SubnetId': place.zone} if place.zone else {})}],
    }
    if options.iam_instance_profile:
        key = 'Arn' if options.iam_instance_profile.startswith('arn:') else 'Name'
        words['IamInstanceProfile'] = {key: options.iam_instance_profile}
    if options.spot:
        words['InstanceMarketOptions'] = {'MarketType': 'spot', 'SpotOptions': {
            'SpotInstanceType': 'one-time', 'InstanceInterruptionBehavior': 'terminate',
            **({'MaxPrice': str(options.max_price)} if options.max_price is not None else {})}}
    return words


def at_shutdown(spec: MachineSpec) -> str:
    """Return EC2's word for what happens to an instance that shuts itself down."""
    return 'stop' if spec.on_exit == 'stop' else 'terminate'


def _root_size(image: Mapping[str, Any], device: str) -> int:
    """Return the size (GB) of an image's disk, which is the minimum of a machine's disk."""
    return max((int(mapping.get('Ebs', {}).get('VolumeSize') or 0)
                for mapping in image.get('BlockDeviceMappings') or ()
                if mapping.get('DeviceName') == device), default=0)


def vm_of(region: str, instance: Mapping[str, Any]) -> Vm:
    """Convert an entry of DescribeInstances."""
    state = STATES.get(instance['State']['Name'], MachineState.PENDING)
    launched = instance.get('LaunchTime')
    return Vm(
        instance['InstanceId'], region, state, tags_of(instance),
        kind=str(instance.get('InstanceType', '')),
        spot=instance.get('InstanceLifecycle') == 'spot', address=address_of(instance),
        private_network=f'aws:{instance["VpcId"]}' if instance.get('VpcId') else '',
        private_ip=str(instance.get('PrivateIpAddress') or ''),
        created=launched.timestamp() if launched is not None else None,
        stopped=_stopped(instance) if state is MachineState.STOPPED else None,
        image=str(instance.get('ImageId', '')), key=str(instance.get('KeyName', '')),
        reason=reason_of(instance))


def address_of(instance: Mapping[str, Any]) -> str:
    """
    Return the address at which a robot reaches an instance, '' while it has none.

    Without a public address it is the private one, to which the user has made a route.
    """
    six = [address['Ipv6Address'] for interface in instance.get('NetworkInterfaces') or ()
           for address in interface.get('Ipv6Addresses') or ()]
    return str(instance.get('PublicIpAddress') or next(iter(six), '')
               or instance.get('PrivateIpAddress') or '')


def reason_of(instance: Mapping[str, Any]) -> str:
    """Return why an instance ended, in EC2's words."""
    reason = instance.get('StateReason') or {}
    return str(reason.get('Message') or reason.get('Code')
               or instance.get('StateTransitionReason') or '')


def instances_in(reservations: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the instances of an answer of DescribeInstances."""
    return [instance for entry in reservations for instance in entry['Instances']]


def _stopped(instance: Mapping[str, Any]) -> Optional[float]:
    match = _STOPPED.search(str(instance.get('StateTransitionReason') or ''))
    return when(f'{match[1]}Z') if match else None
