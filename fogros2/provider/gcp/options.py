# SPDX-License-Identifier: Apache-2.0
"""Options of a Compute Engine instance."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import re
from typing import Any

from fogros2 import untrusted
from fogros2.errors import ConfigurationError
from fogros2.provider.vm.options import VmOptions

_NAME = r'[a-z]([a-z0-9-]{0,61}[a-z0-9])?'
_PROJECT = r'([a-z][a-z0-9.-]*:)?[a-z][a-z0-9-]{4,61}[a-z0-9]'


@dataclasses.dataclass(frozen=True)
class Options(VmOptions):
    """Options of a Compute Engine instance; see :class:`~fogros2.GCPCloudInstance`."""

    project_id: str = ''
    ami_image: str = ''
    zone: str = ''
    machine_type: str = ''
    machine_types: tuple[str, ...] = ()
    accelerators: str = ''
    service_account: str = ''
    network: str = 'default'

    WHAT = 'a machine at Google'
    DEFAULT_TYPE = 'e2-medium'
    IN_ONE_REGION = ('zone',)
    DISK_SIZES = (10, 65536)
    FORMS = {
        'region': (r'nearest|[a-z]+(-[a-z]+)+\d+', "'europe-west3' or 'nearest'"),
        'zone': (r'[a-z]+(-[a-z]+)+\d+-[a-z]', "'us-central1-a'"),
        'project_id': (_PROJECT, "the project's id, not its name or number"),
        'machine_type': (r'cheapest|[a-z][a-z0-9]*(-[a-z0-9]+)+', "'e2-medium' or 'cheapest'"),
        'ami_image': (rf'(projects/{_PROJECT}/)?(global/images/)?(family/)?{_NAME}',
                      "'projects/ubuntu-os-cloud/global/images/family/ubuntu-2404-lts-amd64'"),
        'accelerators': (rf'{_NAME}(:[1-9]\d?)?', "'nvidia-tesla-t4' or 'nvidia-tesla-t4:2'"),
        'service_account': (r'[^@\s]+@[^@\s]+', 'the email address of one'),
        'network': (_NAME, 'the name of a VPC network of the project'),
        'user': (untrusted.NAME.pattern, "a login name, such as 'ubuntu'"),
    }

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Options:
        """Return the options of a spec; a zone names its region."""
        options = super().parse(given)
        return dataclasses.replace(options, region=options.region or options.zone[:-2])

    def check(self) -> None:
        """Check the values."""
        super().check()
        if self.zone and self.region not in ('', self.zone[:-2]):
            raise ConfigurationError(f'the zone {self.zone} is not in the region {self.region}',
                                     'leave region= or zone= out')
        if self.spot and self.max_price is not None:
            raise ConfigurationError('Google takes no limit for a spot price',
                                     'leave max_price= or spot= out')
        for key in self.tags:
            if not re.fullmatch(r'[a-z][a-z0-9_-]{0,62}', key) or key.startswith('fogros2-'):
                raise ConfigurationError(
                    f"'{key}' can't be a label of Google's",
                    'labels have lower-case letters, digits, _ and -, at most 63, begin with a '
                    "letter, and not with 'fogros2-'")

    def gpus(self) -> list[dict[str, Any]]:
        """Return the type and number of the attached GPUs, as ``guestAccelerators`` has them."""
        kind, _, count = self.accelerators.partition(':')
        return [{'acceleratorType': kind, 'acceleratorCount': int(count or 1)}] if kind else []
