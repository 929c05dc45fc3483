# SPDX-License-Identifier: Apache-2.0
"""A provider written from doc/developers/providers_vm.md keeps the contract."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json

import pytest

from fogros2.errors import ConfigurationError, ProviderError, Unsupported
from fogros2.model import MachineSpec
from fogros2.provider.vm import account
from fogros2.provider.vm.cloud import attempt_of, VmCloud
from fogros2_features.prices.market import Market, seller
from fogros2_features.prices.offers import wants
from fogros2_testing import request_for, VmContract
from rigs import serving
from rigs.meadow.provider import Meadow, MeadowProvider
from rigs.meadow.server import Meadow as Service
from rigs.meadow.server import TOKEN


@pytest.fixture
def meadow(hasty, monkeypatch, tmp_path):
    """Serve an empty Meadow on the loopback."""
    state = Service()
    with serving.serve(state) as url:
        for name, value in {
                'MEADOW_URL': url, 'MEADOW_TOKEN': TOKEN, 'MEADOW_REGION': 'north',
                'FOGROS2_ROBOT_ADDRESS': '198.51.100.7',
                'FOGROS2_STATE_HOME': str(tmp_path)}.items():
            monkeypatch.setenv(name, value)
        yield state


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


def test_open_ssh_port_is_warned_of(plain, meadow):
    fleet = dataclasses.replace(spec(fleet=['ssh-ed25519 AAAA robot-2']), on_exit='keep')
    plain.check(fleet)
    machine = plain.create(*ordered())
    assert 'open to the world' in plain.reachable(machine, name='planner', timeout=60.0).note
    with pytest.raises(Unsupported):
        plain.allow(machine, 22, [])
    plain.adopt(machine, spec(), {'fogros2-launch': 'next'})
    assert 'fogros2-launch' not in plain.describe(machine).tags
    data, = (one['user_data'] for one in meadow.machines.values())
    assert base64.b64decode(data).startswith(b'#cloud-config')


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
    {'machine_type': 'large', 'machine_types': ['small']}, {}])
def test_disk_size_beyond_a_fixed_disk_is_an_error(plain, kinds):
    with pytest.raises(ConfigurationError, match='small in north has a disk of 25 GB'):
        plain.resolve(spec(disk_size=100, **kinds))


def test_cheapest_type_has_the_disk_that_is_asked_for(plain):
    chosen = plain.resolve(spec(machine_type='cheapest', disk_size=100))
    assert chosen.options['machine_type'] == 'large'
    with pytest.raises(ConfigurationError, match='a disk of 300 GB'):
        plain.resolve(spec(machine_type='cheapest', disk_size=300))
    found = seller(plain).offers(wants(arch='any', disk_size=100)).offers
    assert [offer.type.name for offer in found] == ['large']


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
