# SPDX-License-Identifier: Apache-2.0
"""EC2 in a box as a test holds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import os
from typing import ClassVar, Optional

from rigs.computers.box import Box, Call, Instance

#: Nobody's; Moto takes any.
_KEY_ID, _SECRET = 'AKIAFOGROS2INABOX000', 'not-a-secret'


class Ec2Box(Box):
    """
    EC2 in a box: AWS's API by Moto, and for each instance a container that is its computer.

    ::

        with Ec2Box() as box:
            ec2 = boto3.client('ec2', region_name='us-east-1', **box.client_arguments)
            ec2.run_instances(...)                       # a computer boots
            subprocess.run(box.on_robot(['ssh', ...]))   # in the robot's network namespace

    It takes ``moto[server]`` besides what every box takes.
    """

    SERVER: ClassVar[str] = 'rigs.ec2.server'
    REGIONS: ClassVar[Sequence[str]] = ('us-east-1', 'eu-central-1', 'us-west-1')

    @property
    def client_arguments(self) -> dict[str, str]:
        """What a boto3 client of this process takes to speak to the box."""
        return {'endpoint_url': self.endpoint, 'aws_access_key_id': _KEY_ID,
                'aws_secret_access_key': _SECRET}

    def environment(self, region: str = 'us-east-1') -> dict[str, str]:
        """Return the variables by which programs on the robot take the box for AWS."""
        return {
            'AWS_ENDPOINT_URL': self.inside, 'AWS_ACCESS_KEY_ID': _KEY_ID,
            'AWS_SECRET_ACCESS_KEY': _SECRET, 'AWS_DEFAULT_REGION': region,
            'AWS_EC2_METADATA_DISABLED': 'true', 'AWS_CONFIG_FILE': os.devnull,
            'AWS_SHARED_CREDENTIALS_FILE': os.devnull,
        }

    def publish(
        self, image: str, *, region: str, files: Optional[Mapping[str, str]] = None,
    ) -> None:
        """
        Let a region have a public AMI of this id, a fresh disk as Ubuntu's is.

        :param files: programs that it has besides, or in the place of others: path and text.
        """
        self._ask({'do': 'publish', 'image': image, 'region': region,
                   'files': dict(files or {})})


__all__ = ['Call', 'Ec2Box', 'Instance']
