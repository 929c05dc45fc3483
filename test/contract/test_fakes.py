# SPDX-License-Identifier: Apache-2.0
"""The fake provider keeps the contract, so that tests with it hold for real ones."""

from __future__ import annotations

from decimal import Decimal

import pytest

from fogros2_testing import FakeProvider, ProviderContract


class TestFakeProvider(ProviderContract):

    def make(self):
        return FakeProvider(polls=2), {'size': 'small'}

    def another(self, provider, spec):
        return provider  # its machines are entries of this object


class CloudLike(FakeProvider):
    """One with a firewall, and with host keys that are handed over."""

    capabilities = FakeProvider.can(firewall=True, one_time_host_key=True)


class TestFakeCloud(TestFakeProvider):

    @pytest.fixture(autouse=True)
    def one(self):
        self.provider = CloudLike(prices={'large': Decimal(2), 'small': Decimal('0.5')})

    def make(self):
        return self.provider, {'size': 'cheapest'}
