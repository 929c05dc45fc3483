# SPDX-License-Identifier: Apache-2.0
"""Fast DDS's profiles by value; what nodes make of them: ``integration/vpn/test_dds_fastdds``."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pytest

from fogros2.dds.fastdds import ASKED, DISCOVERY_GROUP, FastDds, RECEIVE_BUFFER, VARIABLE
from fogros2.errors import DdsError

NS = {'': 'http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles'}


def parsed(text: str) -> Element:
    return ElementTree.fromstring(text.encode())


def peers(text: str) -> list[tuple[str, str]]:
    return [(one.findtext('address', '', NS), one.findtext('port', '', NS))
            for one in parsed(text).iterfind('.//initialPeersList/locator/udpv4', NS)]


def test_the_robot_keeps_all_its_interfaces_and_asks_as_ever() -> None:
    dds = FastDds()
    interfaces = dds.robot_interfaces('fog1', None, {})
    assert interfaces == []
    root = parsed(dds.render(interfaces, ()))
    assert root.find('.//interfaceWhiteList', NS) is None
    assert root.find('.//netmask_filter', NS) is None
    assert root.find('.//initialPeersList', NS) is None
    assert root.findtext('.//leaseDuration/sec', '', NS) == '60'


@pytest.mark.parametrize('user', [{}, {'ROS_LOCALHOST_ONLY': '1'}])
def test_no_node_uses_shared_memory(user: dict[str, str]) -> None:
    dds = FastDds()
    for interfaces in (dds.robot_interfaces('fog1', None, user), dds.machine_interfaces('fog1m0')):
        root = parsed(dds.render(interfaces, (), user))
        assert root.findtext('.//useBuiltinTransports', '', NS) == 'false'
        used = [one.text for one in root.iterfind('.//userTransports/transport_id', NS)]
        descriptors = root.findall('.//transport_descriptor', NS)
        assert [(one.findtext('transport_id', '', NS), one.findtext('type', '', NS),
                 one.findtext('receiveBufferSize', '', NS)) for one in descriptors] == [
            (used[0], 'UDPv4', str(RECEIVE_BUFFER))]
        assert len(used) == 1


def test_more_addresses_are_kept_than_a_robot_has() -> None:
    dds = FastDds()
    for interfaces in ([], dds.machine_interfaces('fog1m0')):
        limit = parsed(dds.render(interfaces, ())).findtext('.//max_unicast_locators', '', NS)
        assert int(limit) >= 32


def test_a_machine_uses_the_vpn_alone_and_sends_nowhere_else() -> None:
    dds = FastDds(2)
    text = dds.render(dds.machine_interfaces('fog1m0'), ['198.18.7.3', '198.18.7.3'])
    root = parsed(text)
    assert [one.text for one in root.iterfind('.//interfaceWhiteList/interface', NS)] == [
        'fog1m0']
    assert root.findtext('.//netmask_filter', '', NS) == 'ON'
    assert root.findtext('.//useBuiltinTransports', '', NS) == 'false'
    assert peers(text) == [(DISCOVERY_GROUP, '7900')] + [
        ('198.18.7.3', str(7910 + 2 * index)) for index in range(ASKED)]


@pytest.mark.parametrize('user', [
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'localhost'}, {'ROS_LOCALHOST_ONLY': '1'}])
def test_who_keeps_to_this_computer_has_it_and_the_vpn(user: dict[str, str]) -> None:
    dds = FastDds()
    text = dds.render(dds.robot_interfaces('fog1', None, user), (), user)
    root = parsed(text)
    assert root.findtext('.//interfaceWhiteList/address', '', NS) == '127.0.0.1'
    assert root.findtext('.//interfaceWhiteList/interface', '', NS) == 'fog1'
    assert {host for host, _ in peers(text)} == {DISCOVERY_GROUP, '127.0.0.1'}
    # the middleware itself would bring transports that listen everywhere
    environment = dds.environment('/x', user)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SYSTEM_DEFAULT'
    assert environment.get('ROS_LOCALHOST_ONLY') != '1'


def test_static_peers_are_asked_beside_the_group() -> None:
    text = FastDds().render([], (), {'ROS_STATIC_PEERS': '192.168.1.5;nuc.local;'})
    assert list(dict.fromkeys(host for host, _ in peers(text))) == [
        DISCOVERY_GROUP, '192.168.1.5', 'nuc.local']


def test_a_users_profiles_are_taken_over(tmp_path: Path) -> None:
    path = tmp_path / 'own.xml'
    path.write_text(f"""<?xml version="1.0"?>
<profiles xmlns="{NS['']}">
  <data_writer profile_name="/scan"><topic><historyQos/></topic></data_writer>
  <participant profile_name="mine" is_default_profile="true">
    <rtps><listenSocketBufferSize>99999</listenSocketBufferSize><builtin><discovery_config>
      <leaseDuration><sec>5</sec></leaseDuration></discovery_config></builtin></rtps>
  </participant>
  <transport_descriptors/>
</profiles>""")
    root = parsed(FastDds().render([], (), {VARIABLE: str(path)}))
    assert root.find('data_writer', NS) is not None
    assert len(root.findall('participant', NS)) == 1
    assert root.findtext('.//leaseDuration/sec', '', NS) == '5'
    assert root.findtext('.//leaseAnnouncement/sec', '', NS) == '3'
    assert root.findtext('.//receiveBufferSize', '', NS) == '99999'
    # Fast DDS reads the file in order
    assert [one.tag.rpartition('}')[2] for one in root] == [
        'transport_descriptors', 'data_writer', 'participant']


@pytest.mark.parametrize(('content', 'words'), [
    (None, "can't be read"), ('<dds', 'no XML'),
    ('<dds><profiles><participant is_default_profile="true"><rtps><useBuiltinTransports>false'
     '</useBuiltinTransports></rtps></participant></profiles></dds>', 'exclude the VPN')])
def test_a_users_profiles_that_cannot_be_used_are_refused(
        tmp_path: Path, content: str | None, words: str) -> None:
    path = tmp_path / 'own.xml'
    if content is not None:
        path.write_text(content)
    with pytest.raises(DdsError, match=words) as caught:
        FastDds().render([], (), {VARIABLE: str(path)})
    assert caught.value.hint


@pytest.mark.parametrize(('name', 'value'), [
    ('ROS_DISCOVERY_SERVER', '127.0.0.1:11811'), ('FASTDDS_BUILTIN_TRANSPORTS', 'LARGE_DATA')])
def test_what_keeps_nodes_from_machines_is_refused(name: str, value: str) -> None:
    with pytest.raises(DdsError, match=name):
        FastDds().robot_interfaces('fog1', None, {name: value})
    with pytest.raises(DdsError, match='OFF'):
        FastDds().environment('/x', {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'})
    with pytest.raises(DdsError, match='no DDS ports'):
        FastDds(300)
    with pytest.raises(DdsError, match="'<x>' of ROS_STATIC_PEERS"):
        FastDds().render([], ['<x>'])
