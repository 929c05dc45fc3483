# SPDX-License-Identifier: Apache-2.0
"""A provider written from doc/developers/providers_vm.md keeps the contract; no mutant does."""

from __future__ import annotations

import base64
from collections.abc import Callable
import dataclasses
import gzip
import json
import threading
from typing import Any, NamedTuple
import uuid

import pytest

from fogros2.errors import ConfigurationError, FogError, ProviderError
from fogros2.model import MachineSpec
from fogros2.provider.offers import wants
from fogros2.provider.vm import account
from fogros2.provider.vm.cloud import attempt_of, CloudError, VmCloud
from fogros2.provider.vm.market import Market
from fogros2.provider.vm.user_data import END_COMMAND
from fogros2_testing import request_for, VmContract
from rigs.meadow import provider as adapter
from rigs.meadow.provider import Meadow, MeadowError, MeadowProvider
from rigs.meadow.server import Meadow as Service
from rigs.meadow.server import serve, TOKEN


@pytest.fixture
def meadow(hasty, monkeypatch, tmp_path):
    """Serve an empty Meadow on the loopback."""
    state = Service()
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


class TestMeadow(VmContract):
    billed_when_off = True
    elsewhere = {'regions': ['south']}

    @pytest.fixture(autouse=True)
    def _service(self, meadow):
        self.service = meadow

    def make(self):
        return MeadowProvider(), {'machine_type': 'cheapest'}

    def left(self):
        return bool(self.service.left())

    def user_data(self, machine_id):
        machine = self.service.machines[machine_id.split('/')[1]]
        return base64.b64decode(machine['user_data'])

    def fault(self, how, times):
        return self.service.fault(how, times)


def spec(**options):
    return MachineSpec('planner', 'meadow', options)


def ordered(**options):
    return spec(**options), request_for(spec(**options))


class PlainMeadow(Meadow):
    """A cloud without a firewall, whose user data is text and whose types have their disks."""

    text_limit = 32768
    set_firewall = VmCloud.set_firewall

    def types(self, region):
        sizes = {'small': 25, 'large': 200}
        return [dataclasses.replace(kind, disk_gb=sizes[kind.name])
                for kind in super().types(region)]


class PlainProvider(MeadowProvider):
    adapter = PlainMeadow
    capabilities = dataclasses.replace(MeadowProvider.capabilities, firewall=False, adopt=False)


@pytest.fixture
def plain(meadow, monkeypatch):
    # any look-up of the robot's address fails
    monkeypatch.setattr('fogros2.provider.vm.provider._ROBOT_ADDRESS', None)
    return PlainProvider()


class TestPlainMeadow:
    """The tests of the contract that depend on what it has no more."""

    billed_when_off, make = True, staticmethod(
        lambda: (PlainProvider(), {'machine_type': 'cheapest'}))
    timeout, machine, reached = VmContract.timeout, VmContract.machine, VmContract.reached
    user_data = TestMeadow.user_data
    test_life, test_tags, test_data, test_adopted, test_firewall, test_port = (
        VmContract.test_machine_starts_and_can_be_reached,
        VmContract.test_machine_has_the_tags_of_its_user,
        VmContract.test_machine_gets_its_user_data,
        VmContract.test_adopted_machine_has_the_tags_of_its_launch,
        VmContract.test_firewall_admits_the_robot_and_closes,
        VmContract.test_port_opens_and_closes)

    @pytest.fixture(autouse=True)
    def _service(self, meadow, plain):
        self.service = meadow


def test_open_ssh_port_is_warned_of(plain):
    fleet = dataclasses.replace(spec(fleet=['ssh-ed25519 AAAA robot-2']), on_exit='keep')
    plain.check(fleet)
    machine = plain.create(*ordered())
    assert 'open to the world' in plain.reachable(machine, name='planner', timeout=60.0).note


def test_ssh_from_is_refused_without_a_firewall(plain):
    with pytest.raises(ConfigurationError, match='no firewall'):
        plain.check(spec(ssh_from=['198.51.100.0/24']))


@pytest.mark.parametrize('networks', [[], '2001:db8::/64'])
def test_fleet_needs_networks_where_there_is_a_firewall(meadow, networks):
    fleet = spec(fleet=['ssh-ed25519 AAAA robot-2'], ssh_from=networks)
    with pytest.raises(ConfigurationError, match='the networks .IPv4. of its robots'):
        MeadowProvider().check(dataclasses.replace(fleet, on_exit='keep'))


def test_user_data_beyond_the_limit_of_text_is_refused(plain, monkeypatch, meadow):
    monkeypatch.setattr(PlainMeadow, 'text_limit', 1000)
    with pytest.raises(ProviderError, match='the cloud takes 1000'):
        plain.create(*ordered())
    assert not meadow.machines


@pytest.mark.parametrize('kinds', [
    {'machine_type': 'small'}, {'machine_type': 'large', 'machine_types': ['small']}, {}])
def test_disk_size_beyond_a_fixed_disk_is_an_error(plain, kinds):
    with pytest.raises(ConfigurationError, match='small in north has a disk of 25 GB'):
        plain.resolve(spec(disk_size=100, **kinds))


def test_cheapest_type_has_the_disk_that_is_asked_for(plain):
    chosen = plain.resolve(spec(machine_type='cheapest', disk_size=100))
    assert chosen.options['machine_type'] == 'large'
    with pytest.raises(ConfigurationError, match='a disk of 300 GB'):
        plain.resolve(spec(machine_type='cheapest', disk_size=300))
    found = plain.offers(wants(arch='any', disk_size=100)).offers
    assert [offer.type.name for offer in found] == ['large']


def test_fixed_disk_is_taken_if_nobody_asks_for_a_size(plain):
    assert plain.resolve(spec(machine_type='small')).options['machine_type'] == 'small'


def test_region_without_places_is_an_error_without_a_price(meadow, monkeypatch):
    monkeypatch.setattr(Meadow, 'places', lambda self, region, order: [])
    with pytest.raises(ProviderError) as caught:
        MeadowProvider().create(*ordered(machine_types=['large']))
    assert caught.value.args[0] == 'Meadow has no small or large in north'
    assert caught.value.no_capacity


def test_price_limit_is_named_if_it_excludes_all_types(meadow):
    with pytest.raises(ProviderError, match=r'in north that is known to cost at most .*=0\.01'):
        MeadowProvider().create(*ordered(machine_type='small', max_price=0.01))


def test_end_command_gets_the_id_of_the_machine(meadow, monkeypatch):
    monkeypatch.setattr(Meadow, 'end_command', lambda self, machine, tags: machine)
    provider = MeadowProvider()
    request = dataclasses.replace(request_for(spec()), agent_config={'launch': 'l1'})
    machine = provider.create(spec(), request)
    attempt = attempt_of(request.token)
    assert provider.describe(machine).end_command == ('north', 'm-1', attempt)
    # nobody knows the id before the machine exists
    data = gzip.decompress(base64.b64decode(meadow.machines['m-1']['user_data'])).decode()
    boot = json.loads(data.partition('\n')[2])['bootcmd']
    assert f'"end_command": ["north", "", "{attempt}"]' in boot[0][-1]


def test_refusal_of_a_cloud_has_had_no_effect():
    assert CloudError('no').refused


def test_lack_of_a_type_is_remembered_for_minutes_only(meadow, monkeypatch, tmp_path):
    now, small, asked = [1e9], {'small': ['north-a'], 'large': ['north-a']}, []
    monkeypatch.setattr(Meadow, 'zones', lambda self, region: dict(small))
    right = Meadow.prices
    monkeypatch.setattr(Meadow, 'prices', lambda self, region, name='': asked.append(
        region) or right(self, region, name))

    def chosen():
        market = Market(Meadow(), cache=tmp_path, clock=lambda: now[0])
        return market.choose(['north'], wants(arch='any')).chosen.type.name

    free = small.pop('small')
    assert chosen() == 'large'
    small['small'] = free
    assert chosen() == 'large'
    now[0] += 301.0
    assert chosen() == 'small'
    assert len(asked) == 1


def test_retry_comes_after_the_pause_that_the_cloud_names(meadow, monkeypatch):
    monkeypatch.setattr(account, 'LONGEST', 30.0)
    with meadow.fault('throttled', 1):
        MeadowProvider().create(*ordered(machine_type='small'))
    first, second = meadow.orders
    assert 1.0 <= second - first < 30.0


# -- mutants --------------------------------------------------------------------------------------

class Mutant(NamedTuple):
    """
    A defect of a provider, and the test of the contract that finds it.

    :param name: of the attribute of ``of`` that ``make`` replaces, given the right one.
    """

    test: str
    of: Any
    name: str
    make: Callable[[Any], Any]
    words: tuple[str, ...] = ()


def without_token(insert):
    """Ask for another machine each time."""
    def mutant(self, place, order, *others):
        request = dataclasses.replace(order.request, token=str(uuid.uuid4()))
        return insert(self, place, dataclasses.replace(order, request=request), *others)
    return mutant


def without_user_data(insert):
    return lambda self, place, order, *others: insert(
        self, place, dataclasses.replace(order, user_data=b''), *others)


def without_tags_of_the_user(insert):
    return lambda self, place, order, prepared, created, tags: insert(
        self, place, order, prepared, created,
        {key: value for key, value in tags.items() if key.startswith('fogros2-')})


def replaced_tags(set_tags):
    return lambda self, machine, tags: self._call(
        'writing labels', 'PUT', self._path(machine.region, machine.vm, 'labels'),
        adapter.RULES.encode(tags))


def only_the_first_tag(set_tags):
    return lambda self, machine, tags: set_tags(self, machine, dict([*tags.items()][:1]))


def without_wait(delete):
    return lambda self, machine: self.end_attempt(machine.region, machine.attempt)


def without_repeats(repeated):
    return lambda self, send, *others, **words: send()


MUTANTS = {
    'tags are replaced': Mutant(
        'test_adopted_machine_has_the_tags_of_its_launch', Meadow, 'set_tags', replaced_tags),
    'one tag of several is written': Mutant(
        'test_adopted_machine_has_the_tags_of_its_launch', Meadow, 'set_tags',
        only_the_first_tag),
    'a pin replaces tags': Mutant(
        'test_pinned_host_key_is_reported_everywhere', Meadow, 'set_tags', replaced_tags),
    'user data is lost': Mutant(
        'test_machine_gets_its_user_data', Meadow, 'insert', without_user_data),
    'end_attempt is empty': Mutant(
        'test_creation_without_answers_leaves_nothing', Meadow, 'end_attempt',
        lambda right: lambda self, region, attempt: False),
    'delete does not wait': Mutant(
        'test_destroy_returns_when_nothing_is_left', Meadow, 'delete', without_wait),
    'requests know of no cancel': Mutant(
        'test_cancel_ends_a_request_without_answer', Meadow, 'until',
        lambda right: lambda self, cancel, hasty=False: right(self, None)),
    'cancel of a request is ignored': Mutant(
        'test_cancel_ends_a_request_without_answer', account, 'cancellable',
        lambda right: lambda call, cancel, **words: call()),
    'capacity errors are not mapped': Mutant(
        'test_lack_of_room_is_reported_and_leaves_nothing', MeadowError, 'FAILURES',
        lambda right: {**right, 'exhausted': adapter.Failure('no room')}),
    'capacity errors end the search': Mutant(
        'test_full_place_leads_to_the_next', MeadowError, 'FAILURES',
        lambda right: {**right, 'exhausted': adapter.Failure('no room')}),
    'insert is not idempotent': Mutant(
        'test_list_that_lags_makes_no_second_machine', Meadow, 'insert', without_token),
    'a repeated insert makes another': Mutant(
        'test_fault_of_a_moment_makes_one_machine_or_none', adapter.Account, '_send',
        lambda right: lambda self, method, url, what, body, *others: right(
            self, method, url, what, body and {**body, 'key': str(uuid.uuid4())}, *others),
        ('lost',)),
    'tags of the user are lost': Mutant(
        'test_machine_has_the_tags_of_its_user', Meadow, 'insert', without_tags_of_the_user),
    'there are no prices': Mutant(
        'test_machine_has_a_price', Meadow, 'prices',
        lambda right: lambda self, region, name='': {}),
    'there are no offers': Mutant(
        'test_offers_are_sorted_by_price', Meadow, 'zones',
        lambda right: lambda self, region: {}),
    'the end only switches off': Mutant(
        'test_machine_ends_its_own_billing', Meadow, 'end_command',
        lambda right: lambda self, *words: END_COMMAND),
    'a script only switches off': Mutant(
        'test_machine_ends_its_own_billing', Meadow, 'end_command',
        lambda right: lambda self, *words: (
            '/bin/sh', '-c', 'sync; sleep 1; /usr/bin/systemctl poweroff -i --no-wall')),
    'throttled requests are not repeated': Mutant(
        'test_throttled_creation_is_made_again', adapter.Account, 'repeated', without_repeats),
}


@pytest.mark.parametrize('name', MUTANTS)
def test_contract_finds(meadow, monkeypatch, tmp_path, name):
    mutant, contract = MUTANTS[name], TestMeadow()
    contract.service = meadow
    test = getattr(contract, mutant.test)
    test(*mutant.words)
    contract.timeout = 2.0  # what a defect keeps back does not come
    meadow.machines.clear()
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path / 'without prices'))
    monkeypatch.setattr(mutant.of, mutant.name, mutant.make(getattr(mutant.of, mutant.name)))
    with pytest.raises((AssertionError, FogError)):
        test(*mutant.words)
