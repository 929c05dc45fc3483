# SPDX-License-Identifier: Apache-2.0
"""A provider that was written from doc/developers/providers.md keeps the contract."""

from __future__ import annotations

import threading

import pytest

from fogros2.errors import ProviderError
from fogros2.model import MachineSpec
from fogros2.testing import ProviderContract, request_for
from rigs.meadow.provider import MeadowProvider
from rigs.meadow.server import Meadow, serve, TOKEN


@pytest.fixture
def meadow(hasty, monkeypatch, tmp_path):
    """Serve an empty Meadow on the loopback."""
    state = Meadow()
    server = serve(state)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    for name, value in {
            'MEADOW_URL': f'http://127.0.0.1:{server.server_port}', 'MEADOW_TOKEN': TOKEN,
            'MEADOW_REGION': 'north', 'FOGROS2_ROBOT_ADDRESS': '198.51.100.7',
            'FOGROS2_STATE_HOME': str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    yield state
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.usefixtures('meadow')
class TestMeadow(ProviderContract):

    def make(self):
        return MeadowProvider(), {'machine_type': 'cheapest'}


def test_full_zone_fails_over_to_the_next(meadow):
    meadow.full = {'north-a'}
    spec = MachineSpec('planner', 'meadow', {'machine_type': 'small'})
    provider = MeadowProvider()
    provider.create(spec, request_for(spec))
    machine, = meadow.machines.values()
    assert machine['zone'] == 'north-b'


def test_full_region_leaves_nothing(meadow):
    meadow.full = {'north-a', 'north-b'}
    spec = MachineSpec('planner', 'meadow', {'machine_type': 'small'})
    with pytest.raises(ProviderError, match='exhausted'):
        MeadowProvider().create(spec, request_for(spec))
    assert not meadow.machines
