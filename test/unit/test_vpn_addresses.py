# SPDX-License-Identifier: Apache-2.0
"""The choice of a subnet and of a port."""

from __future__ import annotations

import ipaddress
import json
import socket

import pytest

from fogros2 import process
from fogros2.errors import ConfigurationError, VpnError
from fogros2.vpn import addresses


def test_the_subnet_is_the_same_for_the_same_launch() -> None:
    first = addresses.choose_subnet([], launch_id='a1b2c3')
    assert first == addresses.choose_subnet([], launch_id='a1b2c3')
    assert ipaddress.IPv4Network(first).subnet_of(ipaddress.IPv4Network('198.18.0.0/15'))
    assert first != addresses.choose_subnet([], launch_id='a1b2c4')


def test_subnet_in_use_is_skipped() -> None:
    first = addresses.choose_subnet([], launch_id='a1b2c3')
    second = addresses.choose_subnet([first], launch_id='a1b2c3')
    assert second != first
    assert addresses.choose_subnet(
        [first, str(ipaddress.ip_network(second)[9])], launch_id='a1b2c3') not in (first, second)


def test_a_proxy_in_half_of_the_pool_leaves_the_other() -> None:
    for launch_id in ('000000', '0000ff', '000100', 'ffffff'):
        subnet = addresses.choose_subnet(['198.18.0.1/16'], launch_id=launch_id)
        assert subnet.startswith('198.19.')


def test_networks_that_overlap_a_launch_are_found() -> None:
    used = ['10.0.0.0/8', '198.18.7.9', '198.18.0.0/16', '198.18.7.128/25', '198.18.8.0/24',
            '0.0.0.0/1', 'fe80::/64']
    assert addresses.overlapping('198.18.7.0/24', used) == [
        '198.18.7.9', '198.18.0.0/16', '198.18.7.128/25']


@pytest.mark.parametrize('everything', ['0.0.0.0/0', '0.0.0.0/1', '128.0.0.0/1', '192.0.0.0/2',
                                        'fe80::1/64', '::/0'])
def test_a_default_route_is_no_collision(everything: str) -> None:
    assert addresses.choose_subnet([everything], launch_id='1') == '198.18.1.0/24'


def test_a_full_pool_is_an_error_with_a_way_out() -> None:
    with pytest.raises(VpnError, match='FOGROS2_VPN_POOL'):
        addresses.choose_subnet(['198.18.0.0/15'], launch_id='1')


def test_the_pool_can_be_another() -> None:
    pool = addresses.pool_from({'FOGROS2_VPN_POOL': '10.213.0.0/16'})
    assert addresses.choose_subnet([], launch_id='2', pool=pool) == '10.213.2.0/24'
    assert addresses.pool_from({}) == addresses.pool_from({'FOGROS2_VPN_POOL': ''})


def test_multicast_groups_of_the_lan_are_no_launchs() -> None:
    taken = ['10.254.0.0/16']
    with pytest.raises(VpnError, match='is free for the VPN'):
        addresses.choose_subnet(taken, launch_id='1', pool='10.254.0.0/15')
    for launch_id in ('000000', '000100', '0001ff'):
        assert addresses.choose_subnet(
            [], launch_id=launch_id, pool='10.254.0.0/15').startswith('10.254.')
    for pool in ('10.255.0.0/16', '192.255.0.0/24'):
        with pytest.raises(ConfigurationError, match='multicast groups would be those of the LAN'):
            addresses.pool_from({'FOGROS2_VPN_POOL': pool})


@pytest.mark.parametrize('text', ['10.0.0.0/25', '10.0.0.1/8', 'fd00::/16', 'lan'])
def test_a_pool_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match='FOGROS2_VPN_POOL'):
        addresses.pool_from({'FOGROS2_VPN_POOL': text})


def test_routes_and_addresses_are_read() -> None:
    routes = [{'dst': 'default', 'gateway': '192.0.2.1'}, {'dst': '10.0.0.0/8', 'dev': 'tun0'},
              {'type': 'local', 'dst': '192.0.2.2'}]
    links = [{}, {'ifname': 'down0', 'addr_info': [{'local': '172.17.0.1', 'prefixlen': 16}]}]
    assert addresses.parse_used(f'{json.dumps(routes)}\n{json.dumps(links)}\n') == [
        '10.0.0.0/8', '172.17.0.0/16', '192.0.2.2/32']
    assert addresses.parse_used('') == []


@pytest.mark.parametrize('text', ['nonsense', '[1]', '[{"dst": "everywhere"}]', '{"a": 1}'])
def test_anything_else_is_an_error(text: str) -> None:
    with pytest.raises(VpnError, match='networks in use'):
        addresses.parse_used(text)


def test_this_computers_own_are_read() -> None:
    output = process.run(addresses.used_networks(), timeout=10.0).stdout
    assert '127.0.0.0/8' in addresses.parse_used(output)


def test_a_port_can_be_fixed() -> None:
    assert addresses.choose_port({'FOGROS2_VPN_PORT': '51820'}) == 51820
    assert addresses.choose_port({'FOGROS2_VPN_PORT': ''}) > 1023


@pytest.mark.parametrize('text', ['0', '65536', '-1', 'any', '5182 0'])
def test_invalid_fixed_port_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match=f'FOGROS2_VPN_PORT={text} is no'):
        addresses.choose_port({'FOGROS2_VPN_PORT': text})


def test_the_port_is_free() -> None:
    port = addresses.choose_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('', port))
    assert not 7400 <= port < 7650
