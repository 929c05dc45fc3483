# SPDX-License-Identifier: Apache-2.0
"""The plugin; apart from the package, because ``configured`` is asked without loading it."""

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
        VmProvider.capabilities, stop=True, keeps_volumes=True,
        preemption_notice=guest.NOTICE)
