# SPDX-License-Identifier: Apache-2.0
"""The configuration of Cyclone DDS, by value."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from fogros2.dds.cyclonedds import CycloneDds
from fogros2.errors import DdsError
from fogros2.model import DdsInterface

VPN = DdsInterface('foga1b2c3', priority=10, required=False)
LOOPBACK = DdsInterface('lo')
NAMESPACE = {'c': 'https://cdds.io/config'}


def rendered(*interfaces: DdsInterface, peers: tuple[str, ...] = ()) -> ElementTree.Element:
    return ElementTree.fromstring(CycloneDds().render(interfaces, peers))


def texts(root: ElementTree.Element, name: str) -> list[str | None]:
    return [element.text for element in root.iterfind(f'.//c:{name}', NAMESPACE)]


def attributes(root: ElementTree.Element, name: str) -> list[dict[str, str]]:
    return [element.attrib for element in root.iterfind(f'.//c:{name}', NAMESPACE)]


def test_the_vpn_is_preferred_and_may_be_absent() -> None:
    root = rendered(LOOPBACK, VPN)
    assert attributes(root, 'NetworkInterface') == [
        {'name': 'foga1b2c3', 'priority': '10', 'multicast': 'false',
         'presence_required': 'false'},
        {'name': 'lo', 'priority': '0', 'multicast': 'false', 'presence_required': 'true'}]


def test_an_interface_may_be_given_by_its_address() -> None:
    assert attributes(rendered(DdsInterface('198.51.100.7')), 'NetworkInterface')[0] == {
        'address': '198.51.100.7', 'priority': '0', 'multicast': 'false',
        'presence_required': 'true'}


def test_peers_are_asked_one_by_one() -> None:
    root = rendered(VPN, LOOPBACK, peers=('198.18.7.2', '198.18.7.3', '198.18.7.2'))
    assert [peer['address'] for peer in attributes(root, 'Peer')] == [
        '127.0.0.1', '198.18.7.2', '198.18.7.3']
    assert texts(root, 'AllowMulticast') == ['false']
    assert texts(root, 'ParticipantIndex') == ['auto']


def test_multicast_is_allowed_where_an_interface_has_it() -> None:
    root = rendered(VPN, DdsInterface('eth0', multicast=True))
    assert texts(root, 'AllowMulticast') == ['true']


def test_messages_are_small_only_where_all_of_them_cross_the_vpn() -> None:
    assert texts(rendered(VPN), 'MaxMessageSize') == ['1380 B']
    assert texts(rendered(VPN, LOOPBACK), 'MaxMessageSize') == []
    assert texts(rendered(LOOPBACK), 'MaxMessageSize') == []
    assert texts(rendered(DdsInterface('127.0.0.1')), 'MaxMessageSize') == []


def test_the_receive_buffer_asks_for_no_minimum() -> None:
    assert attributes(rendered(VPN, LOOPBACK), 'SocketReceiveBufferSize') == [
        {'max': '4194304 B'}]


def test_no_interface_is_an_error() -> None:
    with pytest.raises(DdsError):
        CycloneDds().render([], [])


def test_the_environment_holds_our_file(tmp_path: Path) -> None:
    path = tmp_path / 'a b.xml'
    assert CycloneDds().environment(str(path), {}) == {
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
        'CYCLONEDDS_URI': f'file://{tmp_path}/a b.xml'}


@pytest.mark.parametrize('theirs', [
    'file:///etc/dds.xml', '<CycloneDDS><Domain/></CycloneDDS>', 'file:///etc/dds.xml,'])
def test_the_users_configuration_is_kept_before_ours(theirs: str) -> None:
    environment = CycloneDds().environment('/state/dds.xml', {'CYCLONEDDS_URI': theirs})
    assert environment['CYCLONEDDS_URI'] == f'{theirs.rstrip(",")},file:///state/dds.xml'
    again = CycloneDds().environment('/state/dds.xml', environment)
    assert again == environment


def test_a_path_that_cyclone_would_split_is_refused() -> None:
    with pytest.raises(DdsError, match='comma'):
        CycloneDds().environment('/state/a,b.xml', {})


def test_discovery_that_is_off_is_refused() -> None:
    with pytest.raises(DdsError, match='ROS_AUTOMATIC_DISCOVERY_RANGE'):
        CycloneDds().environment('/state/dds.xml', {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'off'})
