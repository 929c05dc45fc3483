# SPDX-License-Identifier: Apache-2.0
"""The fake provider keeps the contract, so that tests with it hold for real ones."""

from __future__ import annotations

from decimal import Decimal

import pytest

from fogros2.errors import ProviderError
from fogros2.model import Command, MachineSpec, MachineState, Result
from fogros2_testing import (
    FakeProvider,
    FakeShell,
    FakeStream,
    ProviderContract,
    request_for,
)


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


def test_a_fake_provider_remembers_calls_and_fails_as_told():
    provider = FakeProvider(failures={'create': ProviderError('no more machines')})
    spec = MachineSpec('planner', 'fake')
    with pytest.raises(ProviderError, match='no more machines'):
        provider.create(spec, request_for(spec))
    machine_id = provider.create(spec, request_for(spec))
    assert provider.calls == ['check', 'create', 'check', 'create']
    provider.describe(machine_id)
    provider.stop(machine_id)
    assert provider.describe(machine_id).state is MachineState.STOPPED
    provider.start(machine_id)
    assert provider.describe(machine_id).state is MachineState.RUNNING


def test_a_fake_shell_answers_as_told():
    stream = FakeStream()
    shell = FakeShell(handlers={'uname': lambda c: Result(0, 'Fake\n', '')}, streams=[stream])
    assert shell.run(Command(('uname', '-s')), timeout=1).stdout == 'Fake\n'
    assert shell.open(Command(('agent',))) is stream
    assert shell.commands == [Command(('uname', '-s'))]
