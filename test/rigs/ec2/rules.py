# SPDX-License-Identifier: Apache-2.0
"""
EC2's rules that Moto doesn't keep: user data, architectures, what is still in use.

Source of each: the error codes and the pages of the actions in the Amazon EC2 API Reference.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Any

from rigs.computers import cloud_config
from rigs.ec2 import hooks
from rigs.ec2.answers import Refusal


def check(region: str, action: str, params: Mapping[str, str]) -> None:
    """
    Look at a request as EC2 does before it acts.

    :raises Refusal: it breaks a rule.
    """
    if action == 'RunInstances':
        _check_run(region, params)
    elif action == 'StartInstances':
        for instance in _instances(region, params):
            if instance.state in ('stopping', 'shutting-down', 'terminated'):
                raise Refusal('IncorrectInstanceState', f"The instance '{instance.id}' is not in "
                              'a state from which it can be started.')
    elif action == 'DeleteSecurityGroup':
        _check_unused(region, params.get('GroupId', ''))


def _check_run(region: str, params: Mapping[str, str]) -> None:
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


def _check_unused(region: str, group_id: str) -> None:
    backend = hooks.backend_of(region)
    for instance in backend.all_instances():
        used = {group.id for group in instance.security_groups}
        for nic in instance.nics.values():
            used |= {group.id for group in nic.group_set}
        if group_id in used and instance.state != 'terminated':
            raise Refusal('DependencyViolation', f'resource {group_id} has a dependent object')


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
