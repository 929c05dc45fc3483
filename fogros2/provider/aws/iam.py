# SPDX-License-Identifier: Apache-2.0
"""The least that the credentials have to allow: every action that FogROS2's calls take."""

from __future__ import annotations

from typing import Any

#: What a launch takes, from nothing to nothing.
LAUNCH = (
    'ec2:AuthorizeSecurityGroupIngress',
    'ec2:CreateSecurityGroup',
    'ec2:CreateTags',
    'ec2:DeleteKeyPair',
    'ec2:DeleteSecurityGroup',
    'ec2:DescribeAddresses',
    'ec2:DescribeImages',
    'ec2:DescribeInstanceTypes',
    'ec2:DescribeInstances',
    'ec2:DescribeKeyPairs',
    'ec2:DescribeSecurityGroups',
    'ec2:DescribeSubnets',
    'ec2:DescribeVolumes',
    'ec2:ImportKeyPair',
    'ec2:RevokeSecurityGroupIngress',
    'ec2:RunInstances',
    'ec2:TerminateInstances',
    'ssm:GetParameter',
)
#: ``on_exit='stop'``, what a machine has besides, and ``ros2 fog list`` over regions.
MACHINES = (
    'ec2:DeleteVolume',
    'ec2:DescribeRegions',
    'ec2:ReleaseAddress',
    'ec2:StartInstances',
    'ec2:StopInstances',
)
#: ``ros2 fog image``.
IMAGES = (
    'ec2:CreateImage',
    'ec2:DeleteSnapshot',
    'ec2:DeregisterImage',
    'ec2:DescribeSnapshots',
)
#: ``ros2 fog price``, 'cheapest', ``max_price=`` and the cost column.
PRICES = (
    'ec2:DescribeInstanceTypeOfferings',
    'ec2:DescribeSpotPriceHistory',
    'pricing:GetProducts',
)
#: Not needed, but what is refused is told better with it.
HELPFUL = ('sts:DecodeAuthorizationMessage',)

ACTIONS = (*LAUNCH, *MACHINES, *IMAGES, *PRICES, *HELPFUL)
#: Calls that no policy can refuse.
FREE = ('sts:GetCallerIdentity',)


def policy() -> dict[str, Any]:
    """Return the policy document, as IAM takes it; ``doc/aws.md`` has the same."""
    return {
        'Version': '2012-10-17',
        'Statement': [{
            'Sid': 'FogROS2', 'Effect': 'Allow', 'Action': sorted(ACTIONS), 'Resource': '*'}],
    }
