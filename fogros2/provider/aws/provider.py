# SPDX-License-Identifier: Apache-2.0
"""The plugin; apart from the package, because ``configured`` is asked without loading it."""

from __future__ import annotations

import dataclasses

from fogros2.provider.aws import instances
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.vm.provider import VmProvider


class AWSProvider(VmProvider):
    """EC2 instances."""

    name = Ec2.name
    adapter = Ec2
    capabilities = dataclasses.replace(
        VmProvider.capabilities, stop=True, keeps_volumes=True,
        preemption_notice=instances.NOTICE)
