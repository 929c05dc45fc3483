# SPDX-License-Identifier: Apache-2.0
"""The plugin; apart from the package, because ``configured`` is asked without loading it."""

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
        VmProvider.capabilities, stop=True, keeps_volumes=True,
        preemption_notice=ending.NOTICE)
