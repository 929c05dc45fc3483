# SPDX-License-Identifier: Apache-2.0
"""What every provider has to do, as tests."""

# ruff: noqa: D102 - a test says in its name what it holds

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import secrets
import time
from typing import Any, ClassVar, Optional
import uuid

from fogros2.errors import ConfigurationError, MachineNotFound, NameTaken, Unsupported
from fogros2.model import CreateRequest, Machine, MachineSpec, MachineState
from fogros2.provider import Provider, TAG_NAME
from fogros2.testing.shell_contract import raised
from fogros2.waiting import wait_until

#: A key whose private half nobody has; providers look whether it is one.
PUBLIC_KEY = ('ssh-ed25519 '
              'AAAAC3NzaC1lZDI1NTE5AAAAILTdX1OUsetUy/jyOuvKiGOBNBXDpA+BhuJy7Gz4ifrw test')


def request_for(spec: MachineSpec, *, token: Optional[str] = None, **tags: str) -> CreateRequest:
    """Return a request as the core makes it, for a machine that nobody logs in to."""
    return CreateRequest(
        token=token or str(uuid.uuid4()), authorized_key=PUBLIC_KEY,
        tags={TAG_NAME: spec.name, **tags}, vpn_port=51820)


class ProviderContract:
    """
    What every provider has to do; subclass it, and let pytest collect the subclass.

    A provider whose computers exist already sets ``owned`` to False.
    """

    owned: ClassVar[bool] = True
    #: Seconds until a machine can be reached, and until one is gone.
    patience: ClassVar[float] = 60.0

    def make(self) -> tuple[Provider, dict[str, Any]]:
        """Return a provider and the options of the machines to try it with."""
        raise LookupError(f'{type(self).__name__} has to say what it tests: write make()')

    @contextlib.contextmanager
    def machine(self, **tags: str) -> Iterator[tuple[Provider, MachineSpec, CreateRequest, str]]:
        """Yield a new machine; it is gone afterwards."""
        provider, options = self.make()
        spec = MachineSpec(f't{secrets.token_hex(3)}', provider.name, options)
        request = request_for(spec, **tags)
        machine_id = provider.create(spec, request)
        try:
            yield provider, spec, request, machine_id
        finally:
            provider.destroy(machine_id)

    def reached(self, provider: Provider, machine_id: str) -> Machine:
        """Return a machine as soon as it can be reached."""
        def look() -> Optional[Machine]:
            machine = provider.describe(machine_id)
            return machine if machine.shell is not None else None
        return wait_until(look, timeout=self.patience, what='the machine to be reachable')

    def test_check_accepts_what_create_takes(self) -> None:
        provider, options = self.make()
        provider.check(MachineSpec('planner', provider.name, options))

    def test_check_names_an_unknown_option(self) -> None:
        provider, options = self.make()
        spec = MachineSpec('planner', provider.name, {**options, 'sizee': 1})
        error = raised(ConfigurationError, lambda: provider.check(spec))
        assert 'sizee' in str(error)
        assert error.hint

    def test_a_machine_comes_up_and_can_be_reached(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            machine = self.reached(provider, machine_id)
            assert machine.id == machine_id
            assert machine.name == spec.name
            assert machine.provider == provider.name
            assert machine.state is MachineState.RUNNING
            assert machine.vpn_host
            assert machine.owned is self.owned
            if self.owned:
                assert machine.end_command
                assert machine.created is not None
                assert abs(machine.created - time.time()) < self.patience + 60.0

    def test_one_token_makes_one_machine(self) -> None:
        with self.machine() as (provider, spec, request, machine_id):
            assert provider.create(spec, request) == machine_id
            if self.owned:
                assert len(list(provider.find({TAG_NAME: spec.name}))) == 1

    def test_a_name_is_taken_once(self) -> None:
        if not self.owned:
            return
        with self.machine() as (provider, spec, _, machine_id):
            raised(NameTaken, lambda: provider.create(spec, request_for(spec)))
            assert provider.describe(machine_id).state is not MachineState.DELETED

    def test_machines_are_found_by_all_their_tags(self) -> None:
        mark = secrets.token_hex(4)
        if not self.owned:
            provider, _ = self.make()
            raised(Unsupported, lambda: list(provider.find({})))
            return
        with self.machine(**{'fogros2-test': mark}) as (provider, spec, _, machine_id):
            for tags in ({TAG_NAME: spec.name}, {'fogros2-test': mark},
                         {'fogros2-test': mark, TAG_NAME: spec.name}):
                assert [m.id for m in provider.find(tags)] == [machine_id]
            assert machine_id in [m.id for m in provider.find({})]
            assert not list(provider.find({'fogros2-test': mark, TAG_NAME: 'another'}))
            found, = provider.find({'fogros2-test': mark})
            assert found.name == spec.name
            assert found.tags['fogros2-test'] == mark

    def test_destroy_is_idempotent(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            provider.destroy(machine_id)
            provider.destroy(machine_id)
            if self.owned:
                raised(MachineNotFound, lambda: provider.describe(machine_id))
                assert not list(provider.find({TAG_NAME: spec.name}))

    def test_nothing_is_known_of_an_unknown_machine(self) -> None:
        provider, _ = self.make()
        raised(MachineNotFound, lambda: provider.describe('no-such-machine'))

    def test_a_machine_created_again_after_its_end_is_a_new_one(self) -> None:
        if not self.owned:
            return
        with self.machine() as (provider, spec, _, machine_id):
            provider.destroy(machine_id)
            again = provider.create(spec, request_for(spec))
            try:
                assert again != machine_id
            finally:
                provider.destroy(again)
