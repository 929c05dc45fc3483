# SPDX-License-Identifier: Apache-2.0
"""
A provider of virtual machines at Meadow, a made-up cloud, without the requests to its API.

Copy this file and write the methods of ``Meadow``. doc/developers/providers_vm.md has the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
from decimal import Decimal
import os
from typing import Any

from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2.model import MachineSpec
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import Order, Place, Vm, VmCloud, VmId
from fogros2.provider.vm.options import VmOptions
from fogros2.provider.vm.provider import VmProvider
from fogros2.provider.vm.regions import Regions

#: Latitude, longitude, place, and whether the region is open to every account.
TABLE = {'north': (60.2, 24.9, 'Helsinki', True)}


@dataclasses.dataclass(frozen=True)
class MeadowOptions(VmOptions):
    """
    Options of a machine at Meadow.

    It inherits region, regions, by_region, disk_size, spot, arch, min_cpu, min_memory_gb,
    cpu_type, gpu, gpu_memory_gb, max_price, tags, user, ssh_from and fleet.

    :param machine_type: name of a type, or 'cheapest'.
    :param machine_types: types to try after ``machine_type``.
    """

    machine_type: str = ''
    machine_types: tuple[str, ...] = ()
    WHAT = 'a machine at Meadow'
    DEFAULT_TYPE = 'small'
    #: A regular expression and an example; both options need one.
    FORMS = {'region': ('nearest|[a-z]+', "'north'"),
             'machine_type': ('cheapest|[a-z]+', "'small'")}


class Meadow(VmCloud):
    """The API of Meadow."""

    name, title = 'meadow', 'Meadow'
    options = MeadowOptions
    #: The time of a connection to this host is the region's distance.
    regions = Regions('Meadow', TABLE, lambda region: f'{region}.meadow.example')
    #: Regular expression of the cloud's ids.
    id_form = 'm-[0-9a-f]+'
    #: Region of ``whoami`` if no region is configured.
    base_region = 'north'

    @staticmethod
    def configured() -> bool:
        """Return whether there are credentials."""
        return 'MEADOW_TOKEN' in os.environ

    def check_credentials(self) -> None:
        """Raise PrerequisiteError if there are none; make no request."""
        if 'MEADOW_TOKEN' not in os.environ:
            raise PrerequisiteError('MEADOW_TOKEN is not set', 'export MEADOW_TOKEN=...')

    def whoami(self, region: str) -> str:
        """Return a few words about the account."""
        raise NotImplementedError

    def default_region(self) -> str:
        """Return the region of the user's configuration, or ''."""
        return os.environ.get('MEADOW_REGION', '')

    def types(self, region: str) -> list[MachineType]:
        """Return ``MachineType(name, vcpus, cores, memory_gb, 'x86_64' or 'arm64')``."""
        raise NotImplementedError

    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        """Return dollars per hour by type; of one type if ``name`` is set."""
        raise NotImplementedError

    def find(self, region: str, tags: Mapping[str, str]) -> Iterable[Vm]:
        """Return machines with the tag fogros2-attempt and all of ``tags``, none being deleted."""
        raise NotImplementedError

    def get(self, region: str, vm: str) -> Vm | None:
        """
        Return a machine; None if it is too new for the API.

        :raises MachineNotFound: it is unknown, deleted or being deleted.
        """
        raise NotImplementedError

    def insert(self, place: Place, order: Order, prepared: Any, created: list[str],
               tags: Mapping[str, str]) -> str:
        """Request a machine with Ubuntu 24.04 and return its id at once."""
        raise NotImplementedError

    def delete(self, machine: VmId) -> None:
        """Delete ``machine.vm`` in ``machine.region``; return when it is gone or was gone."""
        raise NotImplementedError

    def end_attempt(self, region: str, attempt: str) -> bool:
        """
        Delete the machines with the tag fogros2-attempt ``attempt``; do not wait.

        Return whether there was one.
        """
        raise NotImplementedError

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Let only these networks (CIDR) reach a TCP port; none if ``sources`` is empty."""
        raise NotImplementedError

    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        """Add or replace these tags; other tags stay."""
        raise NotImplementedError


class MeadowProvider(VmProvider):
    """Machines at Meadow."""

    name = 'meadow'
    adapter = Meadow
    #: Lacks stop, preemption_notice and application_port.
    capabilities = VmProvider.capabilities  # dataclasses.replace(..., stop=True) adds one

    def check(self, spec: MachineSpec) -> None:
        """Refuse what Meadow does not have."""
        super().check(spec)
        if MeadowOptions.of(spec).spot:
            raise ConfigurationError('Meadow has no spot machines', 'leave out spot=')
