# SPDX-License-Identifier: Apache-2.0
"""
EC2's rules that Moto doesn't keep: client tokens, spot, architectures, what is still in use.

Source of each: the error codes and the pages of the actions in the Amazon EC2 API Reference.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from decimal import Decimal
import hashlib
import threading
from typing import Any, Optional

from rigs.computers import cloud_config
from rigs.ec2 import hooks, market
from rigs.ec2.answers import Answer, Refusal
from rigs.ec2.cloud import Cloud

#: Parameters of a request that a client token doesn't cover.
_ASIDE = ('Version', 'Action', 'DryRun')


class Tokens:
    """Client tokens: the same request under the same token has one effect."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._locks: dict[tuple[str, str], threading.Lock] = {}
        self._used: dict[tuple[str, str], tuple[str, Answer, list[str]]] = {}

    def lock(self, region: str, token: str) -> threading.Lock:
        """Return what a request under a token has to hold."""
        with self._lock:
            return self._locks.setdefault((region, token), threading.Lock())

    def earlier(self, region: str, params: Mapping[str, str]) -> Optional[Answer]:
        """
        Return the answer to an earlier request under the same token.

        :raises Refusal: that request was another one, or its instance has ended.
        """
        used = self._used.get((region, params.get('ClientToken', '')))
        if used is None:
            return None
        digest, answer, made = used
        if digest != _digest(params):
            raise Refusal('IdempotentParameterMismatch',
                          'The client token has been used with other parameters before')
        backend = hooks.backend_of(region)
        for number in made:
            instance = backend.get_instance_by_id(number)
            if instance is None or instance.state in ('shutting-down', 'terminated'):
                raise Refusal('IdempotentInstanceTerminated',
                              'The client token is that of an instance that was terminated')
        return answer

    def remember(
        self, region: str, params: Mapping[str, str], answer: Answer, made: list[str],
    ) -> None:
        """Keep what a request under a token was answered."""
        self._used[(region, params['ClientToken'])] = (_digest(params), answer, made)


def _digest(params: Mapping[str, str]) -> str:
    text = '\n'.join(f'{key}={value}' for key, value in sorted(params.items())
                     if key not in _ASIDE)
    return hashlib.sha256(text.encode()).hexdigest()


def check(region: str, action: str, params: Mapping[str, str], cloud: Cloud) -> None:
    """
    Look at a request as EC2 does before it acts.

    :raises Refusal: it breaks a rule.
    """
    if action == 'RunInstances':
        _check_run(region, params)
    elif action == 'StopInstances':
        for instance in _instances(region, params):
            machine = cloud.machines.get(instance.id)
            if machine is not None and machine.spot:
                raise Refusal(
                    'UnsupportedOperation',
                    f"You can't stop the Spot Instance '{instance.id}' because it is associated "
                    'with a one-time Spot Instance request.')
            if instance.state in ('shutting-down', 'terminated'):
                raise Refusal('IncorrectInstanceState', f"The instance '{instance.id}' is not in "
                              'a state from which it can be stopped.')
    elif action == 'StartInstances':
        for instance in _instances(region, params):
            if instance.state in ('stopping', 'shutting-down', 'terminated'):
                raise Refusal('IncorrectInstanceState', f"The instance '{instance.id}' is not in "
                              'a state from which it can be started.')
    elif action == 'DeleteSecurityGroup':
        _check_unused(region, params.get('GroupId', ''))


def _check_run(region: str, params: Mapping[str, str]) -> None:
    if len(params.get('ClientToken', '')) > 64:
        raise Refusal('InvalidParameterValue', 'Value for parameter clientToken is too long')
    try:
        data = base64.b64decode(params.get('UserData', ''), validate=True)
        cloud_config.parse(data)
    except (binascii.Error, cloud_config.UserDataError) as error:
        raise Refusal('InvalidParameterValue', f'{error}') from error
    backend = hooks.backend_of(region)
    kind = params.get('InstanceType', 'm1.small')
    facts = types().get(kind)
    image = backend.amis.get(params.get('ImageId', ''))
    number = params.get('ImageId', '')
    if number in backend.deleted_amis or image is not None and image.state != 'available':
        raise Refusal('InvalidAMIID.Unavailable',
                      f"The image id '[{number}]' is no longer available")
    if facts is None:
        raise Refusal('InvalidParameterValue', f"Invalid value '{kind}' for InstanceType.")
    if image is not None:
        known = facts.get('ProcessorInfo', {}).get('SupportedArchitectures', [])
        if image.architecture not in known:
            raise Refusal(
                'InvalidParameterValue',
                f"The architecture '{', '.join(known)}' of the specified instance type does not "
                f"match the architecture '{image.architecture}' of the specified AMI. Specify an "
                'instance type and an AMI that have matching architectures, and try again.')
    zone = params.get('Placement.AvailabilityZone', '')
    subnet = params.get('SubnetId') or params.get('NetworkInterface.1.SubnetId')
    if subnet and subnet in {s.id for s in backend.describe_subnets()}:
        zone = backend.get_subnet(subnet).availability_zone
    if zone and kind not in offered(region).get(zone, ()):
        raise Refusal('Unsupported',
                      f'Your requested instance type ({kind}) is not supported in your requested '
                      f'Availability Zone ({zone}).')
    cap = params.get('InstanceMarketOptions.SpotOptions.MaxPrice')
    if cap:
        price = market.spot_price(region, kind, zone or f'{region}a')
        if price is not None and Decimal(cap) < price:
            raise Refusal('SpotMaxPriceTooLow', f'Your Spot request price of {cap} is lower than '
                          f'the minimum required Spot request fulfillment price of {price}.')


def _check_unused(region: str, group_id: str) -> None:
    backend = hooks.backend_of(region)
    for instance in backend.all_instances():
        used = {group.id for group in instance.security_groups}
        for nic in instance.nics.values():
            used |= {group.id for group in nic.group_set}
        if group_id in used and instance.state != 'terminated':
            raise Refusal('DependencyViolation', f'resource {group_id} has a dependent object')
    for groups in list(backend.groups.values()):
        for group in list(groups.values()):
            for rule in group.ingress_rules:
                if group.id != group_id and (rule.source_group or {}).get('GroupId') == group_id:
                    raise Refusal('DependencyViolation',
                                  f'resource {group_id} has a dependent object')


def _instances(region: str, params: Mapping[str, str]) -> list[Any]:
    backend = hooks.backend_of(region)
    named = [value for key, value in params.items() if key.startswith('InstanceId.')]
    return [i for number in named if (i := backend.get_instance_by_id(number)) is not None]


def types() -> Mapping[str, Mapping[str, Any]]:
    """Return what DescribeInstanceTypes knows of each type."""
    from moto.ec2.models.instance_types import INSTANCE_TYPES
    known: Mapping[str, Mapping[str, Any]] = INSTANCE_TYPES
    return known


def offered(region: str) -> dict[str, set[str]]:
    """Return the types that each zone of a region has."""
    from moto.ec2.models.instance_types import INSTANCE_TYPE_OFFERINGS
    found: dict[str, set[str]] = {}
    for entry in INSTANCE_TYPE_OFFERINGS['availability-zone'].get(region, ()):
        found.setdefault(entry['Location'], set()).add(entry['InstanceType'])
    return found
