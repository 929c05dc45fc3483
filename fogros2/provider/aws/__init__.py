# SPDX-License-Identifier: Apache-2.0
"""
EC2 instances, by boto3.

In reading order: ``options``, ``regions``, ``spot`` (the preemption notice), ``failures`` (AWS's
refusals), ``retry`` and ``clients`` (calls), ``instances``, ``network``, ``ending``,
``prices``, ``images``, ``cloud`` (the adapter).
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from typing import ClassVar, Optional

from fogros2.provider import Capabilities
from fogros2.provider.aws import clients, spot
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.vm.provider import VmProvider

__all__ = ['AWSProvider']


class AWSProvider(VmProvider):
    """
    EC2 instances.

    :param account: the AWS account; None for the account of this computer's user.
    """

    name: ClassVar[str] = 'aws'
    capabilities: ClassVar[Capabilities] = dataclasses.replace(
        VmProvider.capabilities, stop=True, images=True, preemption_notice=spot.NOTICE)

    def __init__(self, account: Optional[Account] = None) -> None:
        super().__init__(Ec2(account))

    @classmethod
    def configured(cls) -> bool:
        """Return whether AWS is set up here."""
        return clients.configured()

    @classmethod
    def region_names(cls) -> Sequence[str]:
        """Return the names of all regions."""
        return tuple(Ec2.regions.table)
