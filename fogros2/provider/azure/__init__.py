# SPDX-License-Identifier: Apache-2.0
"""
Virtual machines of Azure, by its REST API.

In reading order: ``options``, ``failures`` (Azure's refusals), ``account``
(requests), ``machines`` (requests and reports by value), ``ending``, ``prices``, ``images``,
``cloud`` (the adapter).
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from fogros2.provider import Capabilities
from fogros2.provider.azure import ending
from fogros2.provider.azure.cloud import Azure
from fogros2.provider.vm.cloud import VmCloud
from fogros2.provider.vm.provider import VmProvider


class AzureProvider(VmProvider):
    """Virtual machines of Azure."""

    name: ClassVar[str] = Azure.name
    adapter: ClassVar[type[VmCloud]] = Azure
    capabilities: ClassVar[Capabilities] = dataclasses.replace(
        VmProvider.capabilities, stop=True, images=True, preemption_notice=ending.NOTICE)
