# SPDX-License-Identifier: Apache-2.0
"""Options of a machine at Azure."""

from __future__ import annotations

import dataclasses
import re

from fogros2 import untrusted
from fogros2.errors import ConfigurationError
from fogros2.provider.vm.options import VmOptions

#: PR 109's name of an Ubuntu image, which Azure has withdrawn: stands for the default here.
OLD_UBUNTU = 'UbuntuLTS'
_PART = r'[\w.-]+'


@dataclasses.dataclass(frozen=True)
class Options(VmOptions):
    """Options of a machine at Azure; see :class:`~fogros2.AzureCloudInstance`."""

    image: str = ''
    vm_size: str = ''
    vm_sizes: tuple[str, ...] = ()
    resource_group: str = ''

    WHAT = 'a machine at Azure'
    TYPE = 'vm_size'
    TYPES = 'vm_sizes'
    DEFAULT_TYPE = 'Standard_B2als_v2'
    BY_REGION = ('image', 'vm_size')
    RESERVED = ('microsoft', 'azure', 'windows', 'fogros2-')
    FORMS = {
        'region': (r'nearest|[a-z]+[0-9]?', "'westeurope' or 'nearest'"),
        'vm_size': (r'cheapest|[A-Z][A-Za-z0-9]*_[A-Za-z0-9_-]+', "'Standard_B2als_v2'"),
        'image': (rf'{OLD_UBUNTU}|{_PART}:{_PART}:{_PART}:{_PART}|/subscriptions/[\w./()-]+',
                  "'publisher:offer:sku:version' or the resource id of an image"),
        'resource_group': (r'[\w.()-]{1,89}[\w()-]', 'the name of a resource group'),
        'user': (untrusted.NAME.pattern, "a login name, such as 'ubuntu'"),
    }

    def check(self) -> None:
        """Check the values; Azure takes 50 tags, a dozen of which are FogROS2's."""
        super().check()
        for key in self.tags:
            if re.search(r'[<>%&\\?/]', key) or len(self.tags) > 30:
                raise ConfigurationError(f"'{key}' can't be a tag at Azure",
                                         r'a key has none of <>%&\?/, and there are at most 30')
