# SPDX-License-Identifier: Apache-2.0
"""
Google Compute Engine, by its REST API.

In reading order: ``options``, ``guest`` (commands on the machine), ``failures``
(Google's refusals), ``account`` (requests), ``instances``, ``firewall``, ``images``, ``prices``,
``cloud`` (the adapter).
"""

from __future__ import annotations

import dataclasses

from fogros2.provider.gcp import guest
from fogros2.provider.gcp.cloud import ComputeEngine
from fogros2.provider.vm.provider import VmProvider


class GCPProvider(VmProvider):
    """Compute Engine instances."""

    name = ComputeEngine.name
    adapter = ComputeEngine
    capabilities = dataclasses.replace(
        VmProvider.capabilities, stop=True, images=True, preemption_notice=guest.NOTICE)
