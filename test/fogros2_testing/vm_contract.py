# SPDX-License-Identifier: Apache-2.0
"""The contract of a cloud of virtual machines, against a service that tests can disturb."""



from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent import futures
import contextlib
import gzip
import json
import re
import threading
from typing import Any, ClassVar, Literal

import pytest

from fogros2.errors import Cancelled, FogError
from fogros2.model import MachineSpec
from fogros2.provider import TAG_NAME, TAG_ON_EXIT
from fogros2.waiting import in_thread, wait_until
from fogros2_features.prices.market import seller
from fogros2_features.prices.offers import wants
from fogros2_testing.provider_contract import ProviderContract, PUBLIC_KEY, request_for
from fogros2_testing.shell_contract import raised

Fault = Literal['throttled', 'unavailable', 'lost', 'full', 'silent']
#: Requests that fail, if all shall.
ALWAYS = 1000
#: The words of a command that only switches a computer off.
_OFF = frozenset('sudo env nohup busybox sh bash c ec exec sync sleep true shutdown poweroff halt '
                 'systemctl telinit init h P p i f force no wall now'.split())


class VmContract(ProviderContract):
    """
    The contract of a cloud of virtual machines; pytest collects its subclasses.

    The author supplies a service: the cloud's simulation. Its state begins empty in each test.
    """

    #: Whether a machine that switches itself off is still billed, though ``on_exit`` is 'delete'.
    billed_when_off: ClassVar[bool]
    #: Options that add a type or a region, which has room when the first is full.
    elsewhere: ClassVar[Mapping[str, Any]]

    def left(self) -> bool:
        """Return whether the service has a machine in any state, or anything made for one."""
        raise LookupError('write left()')

    def user_data(self, machine_id: str) -> bytes:
        """Return the user data that the service hands to a machine, without a coding."""
        raise LookupError('write user_data()')

    def fault(
        self, how: Fault, times: int,
    ) -> contextlib.AbstractContextManager[threading.Event]:
        """
        Disturb the service in a block: the next ``times`` requests for a machine fail.

        - 'throttled': HTTP 429 with a short Retry-After; it has no effect;
        - 'unavailable': HTTP 503; it has no effect;
        - 'lost': it has its effect, and no answer comes (or HTTP 500);
        - 'full': there is no capacity for its type;
        - 'silent': every request, of reading too, is answered only at the end of the block.

        :returns: in the block, an event that is set when a request has met the fault.
        """
        raise LookupError('write fault()')

    def wanted(self, *, name: str = 'contract', **options: Any) -> tuple[Any, MachineSpec]:
        """Return a new provider, and the spec of a machine."""
        provider, usual = self.make()
        return provider, MachineSpec(name, provider.name, {**usual, **options})

    @contextlib.contextmanager
    def emptied(self) -> Iterator[None]:
        """Check at the end of the block that the service has nothing any more."""
        yield
        wait_until(lambda: not self.left(), timeout=self.timeout,
                   what='everything of the machine to be deleted')

    # -- what a machine gets --------------------------------------------------------------------

    def test_machine_gets_its_user_data(self) -> None:
        with self.machine(agent={'launch': 'of-the-contract'}) as (provider, _, _, machine_id):
            data = self.user_data(machine_id)
            text = data.decode() if data.startswith(b'#') else gzip.decompress(data).decode()
            first, _, config = text.partition('\n')
            assert first == '#cloud-config'
            settings = json.loads(config)
            assert PUBLIC_KEY in settings['ssh_authorized_keys']
            assert 'of-the-contract' in json.dumps(settings['bootcmd'])
            endpoint = self.reached(provider, machine_id).endpoint
            assert endpoint is not None and endpoint.host_key is not None
            assert settings['ssh_keys']['ed25519_public'].split()[:2] \
                == endpoint.host_key.split()[:2]

    def test_machine_has_the_tags_of_its_user(self) -> None:
        with self.machine(options={'tags': {'team': 'Lab 3'}}) as (provider, spec, _, machine_id):
            assert provider.describe(machine_id).tags.get('team') == 'Lab 3'
            assert [one.id for one in provider.find({'team': 'Lab 3'})] == [machine_id]
            if provider.capabilities.adopt:
                provider.adopt(machine_id, spec, {TAG_ON_EXIT: 'keep'})
                assert provider.describe(machine_id).tags.get('team') == 'Lab 3'

    def test_machine_ends_its_own_billing(self) -> None:
        with self.machine({TAG_ON_EXIT: 'delete'}) as (provider, _, _, machine_id):
            command = self.reached(provider, machine_id).end_command
            assert command
            # a folder, such as /sbin, tells nothing
            words = re.findall(r'\w+', re.sub(r'\S*/', ' ', ' '.join(command)))
            assert not (self.billed_when_off and all(
                word in _OFF or word.isdecimal() for word in words)), (
                f'a machine that is off is billed, and {command} only switches it off')

    def test_offers_are_sorted_by_price(self) -> None:
        super().test_offers_are_sorted_by_price()
        provider, spec = self.wanted()
        region = provider.resolve(spec).options['region']
        requirements = wants(arch='any', min_cpu=1, min_memory_gb=0.1)
        assert seller(provider).offers(requirements, [region]).offers

    def test_machine_has_a_price(self) -> None:
        provider, spec = self.wanted()
        price = provider.cost_per_hour(provider.resolve(spec))
        assert price is not None and price > 0
        with self.machine() as (provider, spec, _, machine_id):
            assert self.reached(provider, machine_id).cost_per_hour == price

    # -- what a machine leaves ------------------------------------------------------------------

    def test_destroy_returns_when_nothing_is_left(self) -> None:
        with self.machine() as (provider, _, _, machine_id):
            self.reached(provider, machine_id)
            assert self.left()
            provider.destroy(machine_id)
            assert not self.left()

    def test_creation_without_answers_leaves_nothing(self) -> None:
        provider, spec = self.wanted()
        with self.emptied(), self.fault('lost', ALWAYS):
            error = raised(FogError, lambda: provider.create(spec, request_for(spec)))
            assert error.undo_failures == ()

    def test_cancelled_launch_creates_nothing(self) -> None:
        provider, spec = self.wanted()
        provider.cancel = threading.Event()
        provider.cancel.set()
        raised(Cancelled, lambda: provider.create(spec, request_for(spec)))
        assert not self.left()

    def test_cancel_ends_a_request_without_answer(self) -> None:
        provider, spec = self.wanted()
        provider.cancel = threading.Event()
        with self.emptied(), self.fault('silent', ALWAYS) as met:
            creation = in_thread(lambda: provider.create(spec, request_for(spec)))
            assert met.wait(self.timeout)
            provider.cancel.set()
            # nobody waits for the answer to a request that creates nothing
            assert futures.wait([creation], 10.0).done
            raised(Cancelled, creation.result)

    # -- faults of the service ------------------------------------------------------------------

    def test_throttled_creation_is_made_again(self) -> None:
        with self.fault('throttled', 2) as met, self.machine() as (provider, _, _, machine_id):
            assert met.is_set()
            assert [one.id for one in provider.find({})] == [machine_id]

    @pytest.mark.parametrize('how', ['unavailable', 'lost'])
    def test_fault_of_a_moment_makes_one_machine_or_none(self, how: Fault) -> None:
        provider, spec = self.wanted()
        with self.emptied():
            with self.fault(how, 1) as met:
                created = []
                with contextlib.suppress(FogError):
                    created.append(provider.create(spec, request_for(spec)))
            assert met.is_set()
            if created:
                assert [one.id for one in provider.find({})] == created
                provider.destroy(created[0])

    def test_list_that_lags_makes_no_second_machine(self) -> None:
        with self.machine() as (provider, spec, request, machine_id):
            # clouds list a machine some seconds after its creation
            adapter = vars(provider)['cloud']
            adapter.find = lambda region, tags: []
            assert provider.create(spec, request) == machine_id
            del adapter.find
            assert [one.id for one in provider.find({TAG_NAME: spec.name})] == [machine_id]

    def test_full_place_leads_to_the_next(self) -> None:
        provider, spec = self.wanted(**self.elsewhere)
        with self.emptied():
            with self.fault('full', 1) as met:
                machine_id = provider.create(spec, request_for(spec))
            assert met.is_set()
            assert [one.id for one in provider.find({})] == [machine_id]
            provider.destroy(machine_id)

    def test_lack_of_room_is_reported_and_leaves_nothing(self) -> None:
        provider, spec = self.wanted()
        with self.emptied(), self.fault('full', ALWAYS):
            error = raised(FogError, lambda: provider.create(spec, request_for(spec)))
            # the launch asks another region or cloud
            assert error.no_capacity
            assert error.refused
