# SPDX-License-Identifier: Apache-2.0
"""Fast DDS's profiles by value; what nodes make of them: ``integration/vpn/test_dds_fastdds``."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pytest

from fogros2.dds.fastdds import (
    ASKED,
    DEFAULT_FILE,
    DISCOVERY_GROUP,
    FastDds,
    RECEIVE_BUFFER,
    VARIABLE,
)
from fogros2.errors import DdsError

NS = {'': 'http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles'}


def parsed(text: str) -> Element:
    return ElementTree.fromstring(text.encode())


def locators(text: str, name: str = 'initialPeersList') -> list[tuple[str, str]]:
    """Return the (address, port) pairs of a list."""
    return [(one.findtext('address', '', NS), one.findtext('port', '', NS))
            for one in parsed(text).iterfind(f'.//{name}/locator/udpv4', NS)]


def robot(dds: FastDds, user: dict[str, str] | None = None, **options: bool) -> str:
    """Return the profile of a robot with one machine."""
    return dds.render(dds.robot_interfaces('198.18.7.1', None, user or {}), ['198.18.7.2'],
                      user or {}, **options)


def machine(dds: FastDds) -> str:
    """Return the profile of the first of two machines."""
    return dds.render(dds.machine_interfaces('198.18.7.2'), ['198.18.7.3'])


def test_robot_keeps_all_its_interfaces_and_its_lan() -> None:
    text = robot(FastDds())
    root = parsed(text)
    assert root.find('.//interfaceWhiteList', NS) is None
    assert root.find('.//netmask_filter', NS) is None
    # the first is announced; one group for each port can be joined
    assert locators(text, 'metatrafficMulticastLocatorList') == [
        ('239.18.7.1', '7402'), (DISCOVERY_GROUP, '7400')]
    assert root.findtext('.//max_multicast_locators', '', NS) == '1'
    assert locators(text) == [(DISCOVERY_GROUP, '7400'), ('239.18.7.2', '7402')]
    assert root.findtext('.//leaseDuration/sec', '', NS) == '60'


def test_guest_listens_to_its_lan_and_announces_no_group() -> None:
    text = robot(FastDds(), quiet=True)
    root = parsed(text)
    assert root.find('.//avoid_builtin_multicast', NS) is None
    assert root.find('.//metatrafficMulticastLocatorList', NS) is None
    assert locators(text) == [(DISCOVERY_GROUP, '7400'), ('239.18.7.2', '7402')]


@pytest.mark.parametrize('text', [
    robot(FastDds()), robot(FastDds(), {'ROS_LOCALHOST_ONLY': '1'}), robot(FastDds(), quiet=True),
    machine(FastDds())], ids=['robot', 'local', 'guest', 'machine'])
def test_nodes_use_udp_only_with_large_buffers(text: str) -> None:
    root = parsed(text)
    assert root.findtext('.//useBuiltinTransports', '', NS) == 'false'
    used = [one.text for one in root.iterfind('.//userTransports/transport_id', NS)]
    assert [(one.findtext('transport_id', '', NS), one.findtext('type', '', NS),
             one.findtext('receiveBufferSize', '', NS))
            for one in root.iterfind('.//transport_descriptor', NS)] == [
        (used[0], 'UDPv4', str(RECEIVE_BUFFER))]
    assert len(used) == 1
    # more than Fast DDS keeps by default, and than a robot has
    assert int(root.findtext('.//max_unicast_locators', '', NS)) >= 32


def test_losses_cost_a_few_packets_and_no_flood() -> None:
    root = parsed(robot(FastDds()))
    assert [(one.findtext('name', '', NS), one.findtext('value', '', NS))
            for one in root.iterfind('.//rtps/propertiesPolicy/properties/property', NS)] == [
        ('fastdds.max_message_size', '8784')]
    default = next(one for one in root.iterfind('.//data_writer', NS)
                   if one.get('is_default_profile') == 'true')
    assert default.findtext('times/heartbeatPeriod/nanosec', '', NS) == '200000000'
    assert default.findtext('times/nackResponseDelay/nanosec', '', NS) == '100000000'


def test_machine_uses_the_vpn_alone_and_sends_nowhere_else() -> None:
    text = machine(FastDds(2))
    root = parsed(text)
    assert [one.text for one in root.iterfind('.//interfaceWhiteList/address', NS)] == [
        '198.18.7.2']
    assert root.findtext('.//netmask_filter', '', NS) == 'ON'
    assert root.findtext('.//avoid_builtin_multicast', '', NS) == 'false'
    assert locators(text, 'metatrafficMulticastLocatorList') == [('239.18.7.2', '7902')]
    assert locators(text) == [
        (DISCOVERY_GROUP, '7900'), ('239.18.7.2', '7902'), ('239.18.7.3', '7902')]


@pytest.mark.parametrize('user', [
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'localhost'}, {'ROS_LOCALHOST_ONLY': '1'}])
def test_robot_limited_to_itself_has_the_loopback_and_the_vpn(user: dict[str, str]) -> None:
    text = robot(FastDds(), user)
    assert [one.text for one in parsed(text).iterfind('.//interfaceWhiteList/address', NS)] == [
        '127.0.0.1', '198.18.7.1']
    # not the common group, which another account's node may have joined on the LAN
    assert locators(text, 'metatrafficMulticastLocatorList') == [('239.18.7.1', '7402')]
    assert locators(text)[:3] == [
        (DISCOVERY_GROUP, '7400'), ('239.18.7.1', '7402'), ('239.18.7.2', '7402')]
    # terminals without multicast
    assert locators(text)[3:] == [('127.0.0.1', str(7410 + 2 * index)) for index in range(ASKED)]
    # the middleware itself would bring transports that listen everywhere
    environment = FastDds().environment('/x', user)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SYSTEM_DEFAULT'
    assert environment.get('ROS_LOCALHOST_ONLY') != '1'


@pytest.mark.parametrize('quiet', [False, True])
def test_robot_limited_to_itself_and_its_peers_asks_no_lan(quiet: bool) -> None:
    text = robot(FastDds(), {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                             'ROS_STATIC_PEERS': '192.168.1.5'}, quiet=quiet)
    root = parsed(text)
    assert root.find('.//interfaceWhiteList', NS) is None
    assert list(dict.fromkeys(host for host, _ in locators(text))) == [
        '239.18.7.1', '239.18.7.2', '192.168.1.5', '127.0.0.1']
    assert locators(text, 'metatrafficMulticastLocatorList') == (
        [] if quiet else [('239.18.7.1', '7402')])
    # without a unicast locator, Fast DDS would join the common group
    assert root.find('.//metatrafficUnicastLocatorList/locator', NS) is not None


def test_static_peers_are_asked_beside_the_groups() -> None:
    text = robot(FastDds(), {'ROS_STATIC_PEERS': '192.168.1.5;localhost;'})
    assert list(dict.fromkeys(host for host, _ in locators(text))) == [
        DISCOVERY_GROUP, '239.18.7.2', '192.168.1.5', '127.0.0.1']


def test_a_users_profiles_are_taken_over(tmp_path: Path) -> None:
    path = tmp_path / 'own.xml'
    path.write_text(f"""<?xml version="1.0"?>
<profiles xmlns="{NS['']}">
  <data_writer profile_name="/scan"><topic><historyQos/></topic></data_writer>
  <participant profile_name="mine" is_default_profile="true">
    <rtps><listenSocketBufferSize>99999</listenSocketBufferSize><builtin><discovery_config>
      <leaseDuration><sec>5</sec></leaseDuration></discovery_config></builtin>
      <propertiesPolicy><properties><property><name>a</name><value>b</value></property>
      </properties></propertiesPolicy></rtps>
  </participant>
  <publisher profile_name="slow" is_default_profile="true"/>
  <transport_descriptors/>
</profiles>""")
    root = parsed(robot(FastDds(), {VARIABLE: str(path)}))
    assert [one.get('profile_name') for one in root.iterfind('data_writer', NS)] == [
        '/scan', 'ros_discovery_info']
    assert [one.text for one in root.iterfind('.//property/name', NS)] == [
        'a', 'fastdds.max_message_size']
    assert len(root.findall('participant', NS)) == 1
    assert root.findtext('.//leaseDuration/sec', '', NS) == '5'
    assert root.findtext('.//leaseAnnouncement/sec', '', NS) == '3'
    assert root.findtext('.//receiveBufferSize', '', NS) == '99999'
    # Fast DDS reads the file in order
    assert [one.tag.rpartition('}')[2] for one in root][:4] == [
        'transport_descriptors', 'data_writer', 'participant', 'publisher']


def default_participant(path: Path, rtps: str) -> dict[str, str]:
    """Write a user's default participant; return the environment."""
    path.write_text('<dds><profiles><participant is_default_profile="true"><rtps>'
                    f'{rtps}</rtps></participant></profiles></dds>')
    return {VARIABLE: str(path)}


def test_a_user_without_multicast_stays_out_of_the_common_group(tmp_path: Path) -> None:
    user = default_participant(
        tmp_path / 'own.xml', '<builtin><metatrafficUnicastLocatorList><locator/>'
        '</metatrafficUnicastLocatorList><initialPeersList><locator><udpv4><address>192.168.1.5'
        '</address></udpv4></locator></initialPeersList></builtin>')
    text = robot(FastDds(), user)
    assert locators(text, 'metatrafficMulticastLocatorList') == [('239.18.7.1', '7402')]
    assert [host for host, _ in locators(text)] == ['192.168.1.5', '239.18.7.1', '239.18.7.2']


def test_default_file_of_the_working_directory_is_taken_over(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    default_participant(tmp_path / DEFAULT_FILE, '<name>mine</name>')
    monkeypatch.chdir(tmp_path)
    user = {'HOME': '/root'}
    assert parsed(robot(FastDds(), user)).findtext('.//name', '', NS) == 'mine'
    # nodes read no such file
    assert FastDds().environment('/x', user)['SKIP_DEFAULT_XML_FILE'] == '1'
    for text in (machine(FastDds()), robot(FastDds(), {**user, 'SKIP_DEFAULT_XML_FILE': '1'})):
        assert parsed(text).find('.//rtps/name', NS) is None


@pytest.mark.parametrize(('content', 'words'), [
    (None, "can't be read"), ('<dds', 'no XML')])
def test_a_users_profiles_that_cannot_be_used_are_refused(
        tmp_path: Path, content: str | None, words: str) -> None:
    path = tmp_path / 'own.xml'
    if content is not None:
        path.write_text(content)
    with pytest.raises(DdsError, match=words) as caught:
        robot(FastDds(), {VARIABLE: str(path)})
    assert caught.value.hint


@pytest.mark.parametrize(('rtps', 'words'), [
    ('<useBuiltinTransports>false</useBuiltinTransports>', 'useBuiltinTransports=false'),
    ('<userTransports><transport_id>a</transport_id></userTransports>', 'transport_id=a'),
    ('<builtinTransports>LARGE_DATA</builtinTransports>', 'builtinTransports=LARGE_DATA'),
    ('<builtin><discovery_config><discoveryProtocol> SUPER_CLIENT </discoveryProtocol>'
     '</discovery_config></builtin>', 'discoveryProtocol=SUPER_CLIENT'),
    ('<builtin><discovery_config><ignoreParticipantFlags>FILTER_DIFFERENT_HOST'
     '</ignoreParticipantFlags></discovery_config></builtin>', 'ignoreParticipantFlags=FILTER_D'),
    ('<builtin><metatrafficUnicastLocatorList><locator><udpv4><port>7410</port><address>'
     '192.168.1.2</address></udpv4></locator></metatrafficUnicastLocatorList></builtin>',
     'metatrafficUnicastLocatorList//address=192.168.1.2'),
    ('<defaultUnicastLocatorList><locator><udpv4><address>192.168.1.2</address></udpv4></locator>'
     '</defaultUnicastLocatorList>', 'defaultUnicastLocatorList//address=192.168.1.2'),
    ('<port><portBase>7000</portBase></port>', 'portBase=7000')])
def test_participant_that_meets_no_machine_is_refused(
        tmp_path: Path, rtps: str, words: str) -> None:
    with pytest.raises(DdsError, match=words) as caught:
        robot(FastDds(), default_participant(tmp_path / 'own.xml', rtps))
    assert caught.value.hint
    robot(FastDds(), default_participant(
        tmp_path / 'own.xml', '<useBuiltinTransports>1</useBuiltinTransports><port><portBase>'
        '7400</portBase></port><builtin><discovery_config><discoveryProtocol>SIMPLE'
        '</discoveryProtocol></discovery_config></builtin>'))


@pytest.mark.parametrize(('name', 'value'), [
    ('ROS_DISCOVERY_SERVER', '127.0.0.1:11811'), ('FASTDDS_BUILTIN_TRANSPORTS', 'LARGE_DATA')])
def test_what_keeps_nodes_from_machines_is_refused(name: str, value: str) -> None:
    with pytest.raises(DdsError, match=name):
        robot(FastDds(), {name: value})
    with pytest.raises(DdsError, match='OFF'):
        FastDds().environment('/x', {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'})
    with pytest.raises(DdsError, match='no DDS ports'):
        FastDds(300)
    with pytest.raises(DdsError, match="'<x>' of ROS_STATIC_PEERS"):
        robot(FastDds(), {'ROS_STATIC_PEERS': '<x>'})
    with pytest.raises(DdsError, match="'nosuch.invalid' of ROS_STATIC_PEERS has no IPv4"):
        robot(FastDds(), {'ROS_STATIC_PEERS': '192.168.1.5;nosuch.invalid'})
