# SPDX-License-Identifier: Apache-2.0
"""
Google Compute Engine, by its REST API.

In reading order: ``options``, ``regions``, ``guest`` (commands on the machine), ``failures``
(Google's refusals), ``account`` (requests), ``instances``, ``firewall``, ``images``, ``prices``,
``cloud`` (the adapter).
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from typing import ClassVar, Optional

from fogros2.provider import Capabilities
from fogros2.provider.gcp import account, guest
from fogros2.provider.gcp.account import Account
from fogros2.provider.gcp.cloud import ComputeEngine
from fogros2.provider.vm.provider import VmProvider

__all__ = ['GCPProvider']


class GCPProvider(VmProvider):
    """
    Compute Engine instances.

    :param to: the account; None for the account of this computer's user.
    """

    name: ClassVar[str] = 'gcp'
    capabilities: ClassVar[Capabilities] = dataclasses.replace(
        VmProvider.capabilities, stop=True, images=True, preemption_notice=guest.NOTICE)

    def __init__(self, to: Optional[Account] = None) -> None:
        super().__init__(ComputeEngine(to))

    @classmethod
    def configured(cls) -> bool:
        """Return whether Google Cloud is set up here."""
        return account.configured()

    @classmethod
    def region_names(cls) -> Sequence[str]:
        """Return the names of all regions."""
        return tuple(ComputeEngine.regions.table)
