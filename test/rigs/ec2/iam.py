# SPDX-License-Identifier: Apache-2.0
"""The least that the credentials have to allow: every action that FogROS2's calls take."""

from __future__ import annotations

from typing import Any

from fogros2.provider.vm.cloud import TAG_ATTEMPT, TAG_BAKED, TAG_VOLUME

#: Asked of what anybody has.
LOOK = (
    'ec2:DescribeImages',
    'ec2:DescribeInstanceTypes',
    'ec2:DescribeInstances',
    'ec2:DescribeKeyPairs',
    'ec2:DescribeRegions',
    'ec2:DescribeSecurityGroups',
    'ec2:DescribeSnapshots',
    'ec2:DescribeSpotInstanceRequests',
    'ec2:DescribeSubnets',
    'ec2:DescribeVolumes',
    'ssm:GetParameter',
)
#: ``ros2 fog price``, 'cheapest', ``max_price=`` and the cost column.
PRICES = (
    'ec2:DescribeInstanceTypeOfferings',
    'ec2:DescribeSpotPriceHistory',
    'pricing:GetProducts',
)
#: What makes something new, or names what may be gone already.
MAKE = (
    'ec2:CreateImage',
    'ec2:CreateSecurityGroup',
    'ec2:CreateVolume',
    'ec2:DeleteKeyPair',
    'ec2:ImportKeyPair',
    'ec2:RunInstances',
)
#: What takes a right on a machine and one on a volume.
ATTACH = (
    'ec2:AttachVolume',
    'ec2:DetachVolume',
)
#: What changes or ends a machine: those with FogROS2's tag alone.
CHANGE = (
    *ATTACH,
    'ec2:AuthorizeSecurityGroupIngress',
    'ec2:DeleteSecurityGroup',
    'ec2:DeleteVolume',
    'ec2:ModifyInstanceAttribute',
    'ec2:RevokeSecurityGroupIngress',
    'ec2:StartInstances',
    'ec2:StopInstances',
    'ec2:TerminateInstances',
)
#: The same for volumes.
CHANGE_VOLUMES = (
    *ATTACH,
    'ec2:DeleteVolume',
)
#: The same for images.
CHANGE_IMAGES = (
    'ec2:DeleteSnapshot',
    'ec2:DeregisterImage',
)
TAG = ('ec2:CreateTags',)
#: With ``volumes=`` alone.
VOLUMES = (*ATTACH, 'ec2:CreateVolume')
ACTIONS = (*LOOK, *PRICES, *MAKE, *CHANGE, *CHANGE_VOLUMES, *CHANGE_IMAGES, *TAG)
#: Calls that no policy can refuse.
FREE = ('sts:GetCallerIdentity',)


def policy() -> dict[str, Any]:
    """Return the policy document, as IAM takes it; ``doc/aws.md`` has the same."""
    machine = {'Null': {f'aws:ResourceTag/{TAG_ATTEMPT}': 'false'}}
    image = {'Null': {f'aws:ResourceTag/{TAG_BAKED}': 'false'}}
    born = {'StringEquals': {'ec2:CreateAction': [
        'CreateImage', 'CreateSecurityGroup', 'CreateVolume', 'ImportKeyPair', 'RunInstances']}}
    statements: list[tuple[str, tuple[str, ...], dict[str, Any]]] = [
        ('Look', (*LOOK, *PRICES), {}),
        ('Make', MAKE, {}),
        ('TagWhatIsMade', TAG, born),
        ('TagMachines', TAG, machine),
        ('ChangeMachines', CHANGE, machine),
        ('ChangeVolumes', CHANGE_VOLUMES, {'Null': {f'aws:ResourceTag/{TAG_VOLUME}': 'false'}}),
        ('ChangeImages', CHANGE_IMAGES, image),
    ]
    return {
        'Version': '2012-10-17',
        'Statement': [
            {'Sid': f'FogROS2{name}', 'Effect': 'Allow', 'Action': sorted(actions),
             'Resource': '*', **({'Condition': condition} if condition else {})}
            for name, actions, condition in statements],
    }
