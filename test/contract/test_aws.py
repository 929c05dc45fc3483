# SPDX-License-Identifier: Apache-2.0
"""The AWS provider keeps the contract, against Moto's EC2 on the loopback."""

from __future__ import annotations

import pytest

from fogros2.provider.aws import AWSProvider
from fogros2.testing import ProviderContract


@pytest.mark.usefixtures('moto_aws')
class TestAWSProvider(ProviderContract):

    def make(self):
        return AWSProvider(), {'ec2_instance_type': 't3.medium', 'disk_size': 10}
