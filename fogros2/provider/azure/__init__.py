# SPDX-License-Identifier: Apache-2.0
"""
Virtual machines of Azure, by its REST API.

In reading order: ``options``, ``failures`` (Azure's refusals), ``account``
(requests), ``machines`` (requests and reports by value), ``ending``, ``prices``, ``images``,
``cloud`` (the adapter).
"""

from __future__ import annotations

import dataclasses

from fogros2.provider.azure import ending
from fogros2.provider.azure.cloud import Azure
from fogros2.provider.vm.provider import VmProvider


class AzureProvider(VmProvider):
    """Virtual machines of Azure."""

    name = Azure.name
    adapter = Azure
    capabilities = dataclasses.replace(
        VmProvider.capabilities, stop=True, images=True, preemption_notice=ending.NOTICE)
