# SPDX-License-Identifier: Apache-2.0
"""The Azure provider keeps the contract, against a simulated Azure on the loopback."""

from __future__ import annotations

import pytest

from fogros2.provider.azure import AzureProvider
from fogros2.testing import ProviderContract


@pytest.mark.usefixtures('azure_service')
class TestAzureProvider(ProviderContract):
    timeout = 10.0

    def make(self):
        return AzureProvider(), {'vm_size': 'Standard_B2als_v2', 'region': 'westeurope'}
