# SPDX-License-Identifier: Apache-2.0
"""Run the contract of every provider."""

import json

from fogros2_shelf import ShelfProvider
import pytest

from fogros2.errors import ProviderError
from fogros2.model import CreateRequest, MachineSpec
from fogros2_testing import ProviderContract


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
        options = {'folder': str(self.folder)}
        provider = ShelfProvider()
        provider.search_for([MachineSpec('any', 'shelf', options)])
        return provider, options

    def test_key_of_the_launch_may_log_in(self):
        """Look where sshd of the computer gets the key."""
        with self.machine() as (_, _, request, _):
            loan, = (json.loads(path.read_text()) for path in self.folder.glob('*.loan'))
            assert loan['key'] == request.authorized_key

    def test_full_shelf_is_an_error(self):
        """Ask for a third computer."""
        provider, options = self.make()

        def create(name):
            request = CreateRequest(token=name, tags={'fogros2-name': name},
                                    authorized_key='ssh-ed25519 AAAA', vpn_port=51820)
            return provider.create(MachineSpec(name, 'shelf', options), request)

        for name in ('first', 'second'):
            create(name)
        with pytest.raises(ProviderError, match='free'):
            create('third')
