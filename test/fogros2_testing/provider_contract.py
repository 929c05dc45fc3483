# SPDX-License-Identifier: Apache-2.0
"""The contract of every provider, as tests for pytest."""



from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import dataclasses
import ipaddress
import secrets
import threading
import time
from types import MappingProxyType
from typing import Any, ClassVar, Optional
import uuid

from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    FogError,
    MachineNotFound,
    NameTaken,
    ProviderError,
    Unsupported,
)
from fogros2.model import CreateRequest, Machine, MachineSpec, MachineState
from fogros2.provider import Capabilities, Provider, TAG_EXPIRES, TAG_LAUNCH, TAG_NAME, TAG_ON_EXIT
from fogros2.provider.machine_types import MachineType
from fogros2.waiting import wait_until
from fogros2_features.images.keepers import image_keeper
from fogros2_features.prices.market import seller
from fogros2_features.prices.offers import Offer, wants
from fogros2_testing.shell_contract import raised

#: A public key without a known private key; providers check its format.
PUBLIC_KEY = ('ssh-ed25519 '
              'AAAAC3NzaC1lZDI1NTE5AAAAILTdX1OUsetUy/jyOuvKiGOBNBXDpA+BhuJy7Gz4ifrw test')


def request_for(spec: MachineSpec, *, token: Optional[str] = None, **tags: str) -> CreateRequest:
    """Return a request as the core makes it, with a key that nobody can log in with."""
    return CreateRequest(
        token=token or str(uuid.uuid4()), authorized_key=PUBLIC_KEY,
        tags={TAG_NAME: spec.name, **tags}, vpn_port=51820)


class ProviderContract:
    """
    The contract of every provider; pytest collects its subclasses.

    A test of an optional method depends on the provider's capabilities: with the capability the
    method works, without it the method has the effect of the default.
    """

    #: Seconds until a machine is reachable, and until a deleted machine is gone.
    timeout: ClassVar[float] = 60.0

    def make(self) -> tuple[Provider, dict[str, Any]]:
        """Return a provider, and the options of machines for the tests."""
        raise LookupError(f'{type(self).__name__} has to say what it tests: write make()')

    def another(self, provider: Provider, spec: MachineSpec) -> Provider:
        """Return the provider as another process makes it, which has a record of the machine."""
        made = type(provider)()
        made.search_for([spec])
        return made

    @contextlib.contextmanager
    def machine(
        self, tags: Mapping[str, str] = MappingProxyType({}), *,
        options: Mapping[str, Any] = MappingProxyType({}),
        agent: Mapping[str, Any] = MappingProxyType({}),
    ) -> Iterator[tuple[Provider, MachineSpec, CreateRequest, str]]:
        """
        Yield a new machine, and delete it afterwards.

        :param options: in addition to those of ``make``.
        :param agent: configuration of the agent that ``create`` starts.
        """
        provider, usual = self.make()
        spec = MachineSpec(f't{secrets.token_hex(3)}', provider.name, {**usual, **options})
        if provider.capabilities.stop and tags.get(TAG_ON_EXIT, 'stop') == 'stop':
            spec = dataclasses.replace(spec, on_exit='stop')
        request = dataclasses.replace(request_for(spec, **tags), agent_config=dict(agent))
        machine_id = provider.create(spec, request)
        try:
            yield provider, spec, request, machine_id
        finally:
            provider.destroy(machine_id)

    def reached(self, provider: Provider, machine_id: str, name: str = 'it') -> Machine:
        """Wait until a machine is reachable, and return it."""
        return provider.reachable(machine_id, name=name, timeout=self.timeout)

    # -- before a machine exists ----------------------------------------------------------------

    def test_provider_is_configured_and_answers(self) -> None:
        provider, _ = self.make()
        assert isinstance(provider.capabilities, Capabilities)
        assert provider.configured() is True
        if provider.capabilities.owned:
            assert provider.answers()

    def test_check_accepts_options_and_names_an_unknown_one(self) -> None:
        provider, options = self.make()
        provider.check(MachineSpec('planner', provider.name, options))
        provider.check_here(MachineSpec('planner', provider.name, options))
        spec = MachineSpec('planner', provider.name, {**options, 'sizee': 1})
        error = raised(ConfigurationError, lambda: provider.check(spec))
        assert 'sizee' in str(error)
        assert error.hint

    def test_containers_are_refused_without_the_capability(self) -> None:
        provider, options = self.make()
        spec = MachineSpec('planner', provider.name, options)
        if provider.capabilities.containers:
            provider.check_containers(spec)
        else:
            assert raised(Unsupported, lambda: provider.check_containers(spec)).hint

    def test_resolve_chooses_once_and_create_accepts_it(self) -> None:
        provider, options = self.make()
        spec = MachineSpec('planner', provider.name, options)
        chosen = provider.resolve(spec)
        assert dataclasses.replace(chosen, options=spec.options) == spec
        if not provider.capabilities.choices:
            assert chosen == spec
        provider.check(chosen)
        assert provider.resolve(chosen) == chosen
        assert all(isinstance(words, str) for words in provider.choices(spec, chosen))
        price = provider.cost_per_hour(chosen)
        assert price is None or price >= 0
        assert provider.architecture(chosen) in ('', 'x86_64', 'aarch64', 'armv7l', 'riscv64')
        assert all(folder.startswith('/') for folder in provider.shared_folders(chosen))
        assert isinstance(provider.has_own_packages(chosen), bool)

    # -- a machine's life -----------------------------------------------------------------------

    def test_machine_starts_and_can_be_reached(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            machine = self.reached(provider, machine_id)
            assert machine.id == machine_id
            assert machine.name == spec.name
            assert machine.provider == provider.name
            assert machine.state is MachineState.RUNNING
            assert machine.vpn_host or machine.robot_host
            assert machine.endpoint is not None
            assert machine.endpoint.kind == provider.capabilities.shell_kind
            assert provider.describe(machine_id).endpoint == machine.endpoint
            assert machine.owned is provider.capabilities.owned
            assert isinstance(provider.capabilities_of(machine), Capabilities)
            if provider.capabilities.owned:
                assert machine.end_command
                assert machine.created is not None
                assert abs(machine.created - time.time()) < self.timeout + 60.0
            for sources in (['198.51.100.0/28'], ['198.51.100.0/28', '198.51.100.77/32']):
                host, port = provider.open_port(machine, 8766, sources)
                assert host and 0 < port < 65536
            for _ in range(2):
                provider.open_port(machine, 8766, [])

    def test_one_token_creates_one_machine(self) -> None:
        with self.machine() as (provider, spec, request, machine_id):
            assert provider.create(spec, request) == machine_id
            if provider.capabilities.owned:
                raised(NameTaken, lambda: provider.create(spec, request_for(spec)))
                assert len(list(provider.find({TAG_NAME: spec.name}))) == 1
            assert all(isinstance(words, str) for words in provider.tidy())
            assert provider.describe(machine_id).state is not MachineState.DELETED

    def test_find_returns_machines_with_all_tags(self) -> None:
        mark = secrets.token_hex(4)
        provider, _ = self.make()
        if not provider.capabilities.owned:
            raised(Unsupported, lambda: list(provider.find({})))
            return
        with self.machine({'fogros2-test': mark}) as (provider, spec, _, machine_id):
            for tags in ({TAG_NAME: spec.name}, {'fogros2-test': mark},
                         {'fogros2-test': mark, TAG_NAME: spec.name}):
                assert [m.id for m in provider.find(tags)] == [machine_id]
            assert machine_id in [m.id for m in provider.find({})]
            assert not list(provider.find({'fogros2-test': mark, TAG_NAME: 'another'}))
            other = self.another(provider, spec)
            machine, = other.find({'fogros2-test': mark})
            assert other.describe(machine_id).id == machine_id
            assert machine.name == spec.name
            assert machine.tags['fogros2-test'] == mark

    def test_destroyed_machine_is_gone_and_its_name_is_free(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            self.another(provider, spec).destroy(machine_id)
            provider.destroy(machine_id)
            if not provider.capabilities.owned:
                return
            raised(MachineNotFound, lambda: provider.describe(machine_id))
            assert not list(provider.find({TAG_NAME: spec.name}))
            begin = time.monotonic()
            raised(ProviderError, lambda: self.reached(provider, machine_id))
            assert time.monotonic() - begin < self.timeout / 2
            again = provider.create(spec, request_for(spec))
            try:
                assert again != machine_id
            finally:
                provider.destroy(again)

    def test_unknown_machine_is_not_found(self) -> None:
        provider, _ = self.make()
        raised(MachineNotFound, lambda: provider.describe('no-such-machine'))

    def test_cancel_ends_reachable_but_not_destroy(self) -> None:
        with self.machine() as (provider, spec, _, machine_id):
            provider.cancel = threading.Event()
            provider.cancel.set()
            raised(Cancelled, lambda: self.reached(provider, machine_id))
            provider.destroy(machine_id)

    def test_adopted_machine_has_the_tags_of_its_launch(self) -> None:
        if not self.make()[0].capabilities.adopt:
            return
        with self.machine({TAG_EXPIRES: '1'}) as (provider, spec, _, machine_id):
            before = self.reached(provider, machine_id).tags
            tags = {TAG_EXPIRES: '2', TAG_LAUNCH: 'next'}
            provider.adopt(machine_id, spec, tags)
            assert {**before, **tags}.items() <= provider.describe(machine_id).tags.items()

    def test_stopped_machine_starts_again(self) -> None:
        provider, _ = self.make()
        if not provider.capabilities.stop:
            raised(FogError, lambda: provider.stop('a machine'))
            raised(FogError, lambda: provider.start('a machine'))
            return
        with self.machine() as (provider, _, _, machine_id):
            self.reached(provider, machine_id)
            provider.stop(machine_id)
            wait_until(lambda: provider.describe(machine_id).state is MachineState.STOPPED,
                       timeout=self.timeout, what='the machine to stop')
            provider.start(machine_id)
            assert self.reached(provider, machine_id).id == machine_id

    # -- its network ----------------------------------------------------------------------------

    def test_firewall_admits_the_robot_and_closes(self) -> None:
        provider, _ = self.make()
        if not provider.capabilities.firewall:
            raised(FogError, lambda: provider.allow('a machine', 22, []))
            raised(Unsupported, provider.robot_address)
            return
        with self.machine() as (provider, _, _, machine_id):
            robot = provider.robot_address()
            assert ipaddress.ip_network(robot).num_addresses == 1
            for sources in ([robot], [robot], [], [], [robot]):
                provider.allow(machine_id, 22, sources)

    def test_pinned_host_key_is_reported_everywhere(self) -> None:
        provider, key = self.make()[0], ' '.join(PUBLIC_KEY.split()[:2])
        if not provider.capabilities.one_time_host_key:
            raised(FogError, lambda: provider.pin('a machine', key))
            return
        with self.machine() as (provider, _, request, machine_id):
            self.reached(provider, machine_id)
            provider.pin(machine_id, key)
            another, _ = self.make()
            machine = another.describe(machine_id)
            assert machine.endpoint is not None and machine.endpoint.host_key == key
            assert request.tags.items() <= machine.tags.items()

    # -- images, regions, prices ----------------------------------------------------------------

    def test_baked_image_is_listed_and_deleted(self) -> None:
        provider, _ = self.make()
        try:
            keeper = image_keeper(provider)
        except Unsupported:
            return
        with self.machine() as (provider, spec, _, machine_id):
            self.reached(provider, machine_id)
            image_id = keeper.bake(machine_id, spec.name, 'abcd')
            try:
                image, = (one for one in keeper.images() if one.id == image_id)
                assert (image.name, image.dependencies) == (spec.name, 'abcd')
            finally:
                keeper.delete_image(image_id)
            keeper.delete_image(image_id)
            assert image_id not in [one.id for one in keeper.images()]

    def test_regions_are_known_without_a_request(self) -> None:
        provider, _ = self.make()
        provider.search_in(())
        if not provider.capabilities.regions:
            assert not provider.region_names()
            raised(Unsupported, provider.regions)
            return
        assert len(set(provider.region_names())) == len(provider.region_names()) > 0
        raised(ConfigurationError, lambda: provider.regions(['no-such-region']))

    def test_offers_are_sorted_by_price(self) -> None:
        provider, _ = self.make()
        requirements = wants(arch='any', min_cpu=1, min_memory_gb=0.1)
        spec = MachineSpec('any', 'cheapest', {'min_cpu': 1, 'disk_size': 40})
        offer = Offer('region-1', MachineType('type-1', 2, 1, 4.0, 'x86_64'))
        try:
            chosen = seller(provider).taking(spec, offer)
        except Unsupported:
            return
        assert (chosen.provider, chosen.wanted) == (provider.name, spec.options)
        assert {'region-1', 'type-1', 40} == {*chosen.options.values()}
        with contextlib.suppress(FogError):  # a simulated service may have no price list
            offers = seller(provider).offers(requirements)
            prices = [offer.price for offer in offers.offers if offer.price is not None]
            assert prices == sorted(prices) and offers.regions
