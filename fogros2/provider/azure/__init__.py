# SPDX-License-Identifier: Apache-2.0
"""
Virtual machines of Azure, by its REST API.

In reading order: ``options``, ``regions``, ``failures`` (Azure's refusals), ``account``
(requests), ``machines`` (requests and reports by value), ``ending``, ``prices``, ``images``,
``cloud`` (the adapter).
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from typing import ClassVar, Optional

from fogros2.provider import Capabilities
from fogros2.provider.azure import account, ending
from fogros2.provider.azure.account import Account
from fogros2.provider.azure.cloud import Azure
from fogros2.provider.vm.provider import VmProvider

__all__ = ['AzureProvider']


class AzureProvider(VmProvider):
    """
    Virtual machines of Azure.

    :param user: the account; None for the account of this computer's user.
    """

    name: ClassVar[str] = 'azure'
    capabilities: ClassVar[Capabilities] = dataclasses.replace(
        VmProvider.capabilities, stop=True, images=True, preemption_notice=ending.NOTICE)

    def __init__(self, user: Optional[Account] = None) -> None:
        super().__init__(Azure(user))

    @classmethod
    def configured(cls) -> bool:
        """Return whether Azure is set up here."""
        return account.configured()

    @classmethod
    def region_names(cls) -> Sequence[str]:
        """Return the names of all regions."""
        return tuple(Azure.regions.table)
