# SPDX-License-Identifier: Apache-2.0
"""Run the contract of every provider."""

import json

from fogros2_shelf import ShelfProvider
import pytest

from fogros2.testing import ProviderContract


class TestShelf(ProviderContract):
    """The contract, with two computers."""

    timeout = 5.0

    @pytest.fixture(autouse=True)
    def shelf(self, tmp_path):
        """Describe the computers."""
        self.folder = tmp_path
        for name in ('one', 'two'):
            (tmp_path / f'{name}.json').write_text(json.dumps(
                {'host': '198.51.100.1', 'host_key': 'ssh-ed25519 AAAA'}))

    def make(self):
        """Return a provider, and the options of its machines."""
        return ShelfProvider(str(self.folder)), {'folder': str(self.folder)}
