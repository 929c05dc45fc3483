# SPDX-License-Identifier: Apache-2.0
"""Options of an EC2 instance."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import re
from typing import ClassVar

from fogros2.errors import ConfigurationError
from fogros2.provider.vm.options import VmOptions


@dataclasses.dataclass(frozen=True)
class Options(VmOptions):
    """Options of an EC2 instance; see :class:`~fogros2.AWSCloudInstance`."""

    ami_image: str = ''
    ec2_instance_type: str = ''
    instance_types: tuple[str, ...] = ()
    iam_instance_profile: str = ''
    subnet: str = ''
    security_groups: tuple[str, ...] = ()

    WHAT: ClassVar[str] = 'a machine at AWS'
    TYPE: ClassVar[str] = 'ec2_instance_type'
    TYPES: ClassVar[str] = 'instance_types'
    DEFAULT_TYPE: ClassVar[str] = 't3.medium'
    IMAGE: ClassVar[str] = 'ami_image'
    BY_REGION: ClassVar[tuple[str, ...]] = ('ami_image', 'ec2_instance_type', 'subnet')
    IN_ONE_REGION: ClassVar[tuple[str, ...]] = ('subnet',)
    RESERVED: ClassVar[tuple[str, ...]] = ('aws:', 'fogros2-')
    FORMS: ClassVar[Mapping[str, tuple[str, str]]] = {
        'region': (r'nearest|[a-z]{2,4}(-[a-z]+)+-\d+', "'eu-central-1' or 'nearest'"),
        'ec2_instance_type': (r'cheapest|[a-z0-9-]+\.[a-z0-9-]+', "'t3.medium' or 'cheapest'"),
        'ami_image': (r'ami-[0-9a-f]+', 'ami-...'),
        'subnet': (r'subnet-[0-9a-f]+', 'subnet-...'),
        'user': (r'[a-z_][a-z0-9_-]{0,31}', "a login name, such as 'ubuntu'"),
    }

    def check(self) -> None:
        """Check the values."""
        super().check()
        for group in self.security_groups:
            if not re.fullmatch(r'sg-[0-9a-f]+', group):
                raise ConfigurationError(f"'{group}' is no id of a security group",
                                         'security_groups= takes sg-...')
