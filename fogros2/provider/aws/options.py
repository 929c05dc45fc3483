# SPDX-License-Identifier: Apache-2.0
"""Options of an EC2 instance."""

from __future__ import annotations

import dataclasses

from fogros2 import untrusted
from fogros2.provider.vm.options import VmOptions


@dataclasses.dataclass(frozen=True)
class Options(VmOptions):
    """Options of an EC2 instance; see :class:`~fogros2.AWSCloudInstance`."""

    ami_image: str = ''
    ec2_instance_type: str = ''
    instance_types: tuple[str, ...] = ()
    iam_instance_profile: str = ''
    subnet: str = ''

    WHAT = 'a machine at AWS'
    TYPE = 'ec2_instance_type'
    TYPES = 'instance_types'
    DEFAULT_TYPE = 't3.medium'
    IMAGE = 'ami_image'
    BY_REGION = ('ami_image', 'ec2_instance_type', 'subnet')
    IN_ONE_REGION = ('subnet',)
    RESERVED = ('aws:', 'fogros2-')
    FORMS = {
        'region': (r'nearest|[a-z]{2,4}(-[a-z]+)+-\d+', "'eu-central-1' or 'nearest'"),
        'ec2_instance_type': (r'cheapest|[a-z0-9-]+\.[a-z0-9-]+', "'t3.medium' or 'cheapest'"),
        'ami_image': (r'ami-[0-9a-f]+', 'ami-...'),
        'subnet': (r'subnet-[0-9a-f]+', 'subnet-...'),
        'user': (untrusted.NAME.pattern, "a login name, such as 'ubuntu'"),
    }
