# SPDX-License-Identifier: Apache-2.0
"""The provider of Google Cloud keeps the contract, against Compute Engine in a box."""

from __future__ import annotations

import pytest

from fogros2.provider.gcp import GCPProvider
from fogros2.testing import ProviderContract


@pytest.mark.usefixtures('gce')
class TestGCPProvider(ProviderContract):

    def make(self):
        return GCPProvider(), {'region': 'europe-west3', 'disk_size': 10}
