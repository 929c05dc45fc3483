# SPDX-License-Identifier: Apache-2.0
"""The contract of every provider, as tests."""

# ruff: noqa: D102 - a test says in its name what it holds

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
import ipaddress
import secrets
import threading
import time
from typing import Any, ClassVar, Optional
import uuid

from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    MachineNotFound,
    NameTaken,
    ProviderError,
    Unsupported,
)
from fogros2.model import CreateRequest, Machine, MachineSpec, MachineState
from fogros2.provider import Provider, TAG_NAME
from fogros2.testing.shell_contract import raised

#: A public key without a known private key; providers check its format.
PUBLIC_KEY = ('ssh-ed25519 '
              'AAAAC3NzaC1lZDI1NTE5AAAAILTdX1OUsetUy/jyOuvKiGOBNBXDpA+BhuJy7Gz4ifrw test')


def request_for(spec: MachineSpec, *, token: Optional[str] = None, **tags: str) -> CreateRequest:
    """Return a request like the core's, for a machine without logins."""
    return CreateRequest(
        token=token or str(uuid.uuid4()), authorized_key=PUBLIC_KEY,
        tags={TAG_NAME: spec.name, **tags}, vpn_port=51820)


class ProviderContract:
    """
    The contract of every provider; pytest collects its subclasses.

    Tests of optional features depend on a class attribute (``owned``, ``firewall``, ...).
    """

    #: Seconds until a machine is reachable, and until a deleted machine is gone.
    patience: ClassVar[float] = 60.0

    def make(self) -> tuple[Provider, dict[str, Any]]:
        """Return a provider, and the options of machines for the tests."""
        raise LookupError(f'{type(self).__name__} has to say what it tests: write make()')

    @contextlib.contextmanager
    def machine(self, **tags: str) -> Iterator[tuple[Provider, MachineSpec, CreateRequest, str]]:
        """Yield a new machine, and delete it afterwards."""
        provider, options = self.make()
        spec = MachineSpec(f't{secrets.token_hex(3)}', provider.name, options)
        request = request_for(spec, **tags)
        machine_id = provider.create(spec, request)
        try:
            yield provider, spec, request, machine_id
        finally:
            provider.destroy(machine_id)

    def reached(self, provider: Provider, machine_id: str, name: str = 'it') -> Machine:
        """Wait until a machine is reachable, and return it."""
        return provider.reachable(
            machine_id, name=name, timeout=self.patience, cancel=threading.Event())

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
            assert machine.vpn_host or machine.robot_host
            assert machine.shell is not None and machine.shell.kind == provider.shell_kind
            assert provider.describe(machine_id).shell == machine.shell
            assert machine.owned is provider.owned
            if provider.owned:
                assert machine.end_command
                assert machine.created is not None
                assert abs(machine.created - time.time()) < self.patience + 60.0

    def test_one_token_makes_one_machine(self) -> None:
        with self.machine() as (provider, spec, request, machine_id):
            assert provider.create(spec, request) == machine_id
            if provider.owned:
                assert len(list(provider.find({TAG_NAME: spec.name}))) == 1

    def test_a_name_is_taken_once(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            if not provider.owned:
                return
            raised(NameTaken, lambda: provider.create(spec, request_for(spec)))
            assert provider.describe(machine_id).state is not MachineState.DELETED

    def test_machines_are_found_by_all_their_tags(self) -> None:
        mark = secrets.token_hex(4)
        provider, _ = self.make()
        if not provider.owned:
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
            if provider.owned:
                raised(MachineNotFound, lambda: provider.describe(machine_id))
                assert not list(provider.find({TAG_NAME: spec.name}))

    def test_nothing_is_known_of_an_unknown_machine(self) -> None:
        provider, _ = self.make()
        raised(MachineNotFound, lambda: provider.describe('no-such-machine'))

    def test_a_machine_created_again_after_its_end_is_a_new_one(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            if not provider.owned:
                return
            provider.destroy(machine_id)
            again = provider.create(spec, request_for(spec))
            try:
                assert again != machine_id
            finally:
                provider.destroy(again)

    def test_choices_are_made_once_and_create_takes_them(self) -> None:
        provider, options = self.make()
        spec = MachineSpec('planner', provider.name, options)
        chosen = provider.resolve(spec)
        assert dataclasses.replace(chosen, options=spec.options) == spec
        provider.check(chosen)
        assert provider.resolve(chosen) == chosen
        price = provider.cost_per_hour(chosen)
        assert price is None or price >= 0

    def test_waiting_for_a_machine_ends_with_the_launch(self) -> None:
        cancel = threading.Event()
        cancel.set()
        with self.machine() as (provider, spec, _, machine_id):
            raised(Cancelled, lambda: provider.reachable(
                machine_id, name=spec.name, timeout=self.patience, cancel=cancel))

    def test_waiting_for_a_machine_that_is_gone_ends_at_once(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            if not provider.owned:
                return
            provider.destroy(machine_id)
            begin = time.monotonic()
            raised(ProviderError, lambda: provider.reachable(
                machine_id, name=spec.name, timeout=self.patience, cancel=threading.Event()))
            assert time.monotonic() - begin < self.patience / 2

    def test_a_firewall_lets_the_robot_in_and_is_closed_again(self) -> None:
        with self.machine() as (provider, _, _, machine_id):
            if not provider.firewall:
                raised(Unsupported, lambda: provider.allow(machine_id, 22, []))
                raised(Unsupported, provider.robot_address)
                return
            robot = provider.robot_address()
            assert ipaddress.ip_network(robot).num_addresses == 1
            for sources in ([robot], [robot], [], [], [robot]):
                provider.allow(machine_id, 22, sources)

    def test_a_port_is_published_and_closed_again(self) -> None:
        with self.machine() as (provider, _, _, machine_id):
            machine = self.reached(provider, machine_id)
            for sources in (['198.51.100.0/28'], ['198.51.100.0/28', '198.51.100.77/32']):
                host, port = provider.publish(machine, 8766, sources)
                assert host and 0 < port < 65536
            for _ in range(2):
                provider.publish(machine, 8766, [])

    def test_a_host_key_of_the_machine_s_own_is_told_from_then_on(self) -> None:
        with self.machine() as (provider, _, _, machine_id):
            key = ' '.join(PUBLIC_KEY.split()[:2])
            if not provider.one_time_host_key:
                raised(Unsupported, lambda: provider.pin(machine_id, key))
                return
            self.reached(provider, machine_id)
            provider.pin(machine_id, key)
            another, _ = self.make()
            shell = another.describe(machine_id).shell
            assert shell is not None and shell.host_key == key
