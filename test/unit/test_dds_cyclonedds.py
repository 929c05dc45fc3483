# SPDX-License-Identifier: Apache-2.0
"""The configuration of Cyclone DDS, by value."""

from __future__ import annotations

import json
import os
from pathlib import Path
import subprocess
import sys
from xml.etree import ElementTree

import pytest

from fogros2 import process
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.errors import DdsError
from fogros2.model import DdsInterface

VPN = DdsInterface('foga1b2c3', priority=10, required=False)
LOOPBACK = DdsInterface('lo')
NAMESPACE = {'c': 'https://cdds.io/config'}
CYCLONE = CycloneDds()


def rendered(*interfaces: DdsInterface, peers: tuple[str, ...] = ()) -> ElementTree.Element:
    return ElementTree.fromstring(CYCLONE.render(interfaces, peers))


def texts(root: ElementTree.Element, name: str) -> list[str | None]:
    return [element.text for element in root.iterfind(f'.//c:{name}', NAMESPACE)]


def attributes(root: ElementTree.Element, name: str) -> list[dict[str, str]]:
    return [element.attrib for element in root.iterfind(f'.//c:{name}', NAMESPACE)]


def test_the_robot_prefers_itself_then_its_lan_then_the_vpn() -> None:
    root = rendered(*CYCLONE.robot_interfaces('foga1b2c3', 'eth0', {}), peers=('198.18.7.2',))
    found = attributes(root, 'NetworkInterface')
    assert [interface['name'] for interface in found] == ['lo', 'eth0', 'foga1b2c3']
    assert [interface['presence_required'] for interface in found] == ['true', 'false', 'false']
    assert all(interface['multicast'] == 'true' for interface in found)
    assert texts(root, 'AllowMulticast') == ['spdp']
    assert texts(root, 'MulticastRecvNetworkInterfaceAddresses') == ['all']
    assert texts(root, 'MaxAutoParticipantIndex') == ['119']
    assert texts(root, 'DontRoute') == []
    assert attributes(root, 'Peer') == []


@pytest.mark.parametrize('lan, user', [
    ('eth0', {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}),
    ('eth0', {'ROS_LOCALHOST_ONLY': '1'}), (None, {})])
def test_robot_without_a_lan_uses_the_loopback(lan: str | None, user: dict[str, str]) -> None:
    interfaces = CYCLONE.robot_interfaces('foga1b2c3', lan, user)
    assert [interface.name for interface in interfaces] == ['lo', 'foga1b2c3']
    assert texts(rendered(*interfaces), 'DontRoute') == []


def test_machine_uses_vpn_and_loopback_only() -> None:
    root = rendered(*CYCLONE.machine_interfaces('foga1b2c3m0'))
    assert attributes(root, 'NetworkInterface') == [
        {'name': 'foga1b2c3m0', 'priority': '10', 'multicast': 'true',
         'presence_required': 'false'},
        {'name': 'lo', 'priority': '0', 'multicast': 'true', 'presence_required': 'true'}]
    assert texts(root, 'ParticipantIndex') == ['auto']
    assert texts(root, 'DontRoute') == ['true']
    assert attributes(root, 'Peer') == []


@pytest.mark.parametrize('domain, port', [(0, 7410), (5, 8660)])
def test_peer_ports_are_those_of_the_domain(domain: int, port: int) -> None:
    interfaces = CYCLONE.machine_interfaces('foga1b2c3m0')
    root = ElementTree.fromstring(
        CycloneDds(domain).render(interfaces, ['198.18.7.3', '198.18.7.4', '198.18.7.3']))
    assert [peer['address'] for peer in attributes(root, 'Peer')] == [
        f'198.18.7.{host}:{port + 2 * i}' for host in (3, 4) for i in range(10)]
    assert texts(root, 'MaxAutoParticipantIndex') == ['119']


def test_a_domain_without_ports_is_refused() -> None:
    with pytest.raises(DdsError, match='ROS_DOMAIN_ID 233'):
        CycloneDds(233)


@pytest.mark.parametrize('variable', ['CYCLONEDDS_URI', 'ROS_STATIC_PEERS'])
def test_static_peers_put_the_lan_first(variable: str) -> None:
    user = {variable: '<CycloneDDS><Discovery><Peers><Peer address="192.168.0.7"/></Peers>'
                      '</Discovery></CycloneDDS>'}
    root = rendered(*CYCLONE.robot_interfaces('foga1b2c3', 'eth0', user))
    assert [interface['name'] for interface in attributes(root, 'NetworkInterface')] == [
        'eth0', 'lo', 'foga1b2c3']


def test_peers_of_a_robot_limited_to_itself_are_refused() -> None:
    user = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with pytest.raises(DdsError, match='would not meet those of ROS_STATIC_PEERS'):
        CYCLONE.robot_interfaces('vpn', 'eth0', {**user, 'ROS_STATIC_PEERS': '192.168.0.7'})
    CYCLONE.robot_interfaces('vpn', 'eth0', {**user, 'ROS_STATIC_PEERS': '127.0.0.1'})


def test_configuration_without_room_for_the_vpn_is_refused() -> None:
    uri = '<CycloneDDS><General><NetworkInterfaceAddress>eth0</NetworkInterfaceAddress></General>'
    with pytest.raises(DdsError, match='NetworkInterfaceAddress'):
        CYCLONE.robot_interfaces('foga1b2c3', 'eth0', {'CYCLONEDDS_URI': uri})


def test_configuration_without_multicast_is_refused() -> None:
    some, none = (f'<General><AllowMulticast>{value}</></>' for value in ('spdp', ' False '))
    with pytest.raises(DdsError, match='AllowMulticast is false'):
        CYCLONE.robot_interfaces('foga1b2c3', 'eth0', {'CYCLONEDDS_URI': f'{some},{none}'})
    # the last value is valid
    CYCLONE.robot_interfaces('foga1b2c3', 'eth0', {'CYCLONEDDS_URI': f'{none},{some}'})


@pytest.mark.parametrize('setting', [
    '<Discovery><Tag>a</Tag></Discovery>', '<General><Transport>tcp</Transport></General>',
    '<Discovery><SPDPMulticastAddress>239.1.2.3</SPDPMulticastAddress></Discovery>',
    '<Discovery><ExternalDomainId>7</ExternalDomainId></Discovery>',
    '<Discovery><Ports><Base>7000</Base></Ports></Discovery>',
    '<Security><Authentication><PrivateKey>a</PrivateKey></Authentication></Security>'])
def test_settings_that_machines_do_not_share_are_refused(setting: str) -> None:
    with pytest.raises(DdsError, match='would not meet those of machines') as caught:
        CYCLONE.robot_interfaces('vpn', None, {'CYCLONEDDS_URI': setting})
    assert caught.value.hint
    CYCLONE.robot_interfaces('vpn', None, {'CYCLONEDDS_URI': '<General><Transport>UDP</></>'})


INSIDE = '<CycloneDDS><Domain><General><Interfaces>{}</Interfaces></General></Domain></CycloneDDS>'
#: Forms of CYCLONEDDS_URI that Cyclone reads, and the interfaces that it takes from them.
FORMS = {
    'comments': ('<!-- <NetworkInterface name="eth1"/> --><CycloneDDS><!-- </CycloneDDS> '
                 '<NetworkInterface name="eth1"/> <NetworkInterfaceAddress>a'
                 '</NetworkInterfaceAddress><Peer address="1.2.3.4"/> --><Domain/></CycloneDDS>',
                 ['eth0', 'lo', 'vpn']),
    'single quotes': (INSIDE.format("<NetworkInterface multicast='true' name='lo'/>"), ['vpn']),
    'spaces': (INSIDE.format('<NetworkInterface\n\tname = "lo" multicast = "true" />'), ['vpn']),
    'any case': (INSIDE.format('<networkinterface NAME="lo" Multicast="TRUE"/>').lower(), ['vpn']),
    'address': (INSIDE.format("<NetworkInterface address='127.0.0.1' multicast='true'/>"),
                ['vpn']),
    'variable': (INSIDE.format('<NetworkInterface name="${FOGT_IF}" multicast="true"/>'),
                 ['vpn']),
    'default of a variable': (
        INSIDE.format('<NetworkInterface name="${FOGT_NONE:-lo}" multicast="true"/>'), ['vpn']),
    'ends without a name': ('<CycloneDDS><Domain><General><Interfaces><NetworkInterface '
                            'name="lo" multicast="true"/></></></></>', ['vpn']),
    'no ends': ('<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" '
                'multicast="true"/>', ['vpn']),
    'no root': ('<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>'
                '</General>', ['vpn']),
    'another domain': ('<CycloneDDS><Domain Id="7"><General><NetworkInterfaceAddress>eth1'
                       '</NetworkInterfaceAddress></General></Domain></CycloneDDS>',
                       ['eth0', 'lo', 'vpn']),
    'this domain': ('<CycloneDDS><Domain id="0"><General><Interfaces><NetworkInterface name="lo" '
                    'multicast="true"/></Interfaces></General></Domain></CycloneDDS>', ['vpn']),
    'several': ('<CycloneDDS/><CycloneDDS><Domain/></CycloneDDS>, '
                + INSIDE.format('<NetworkInterface name="lo" multicast="true"/>'), ['vpn']),
    'declaration': ('<?xml version="1.0" encoding="UTF-8" ?>\n<CycloneDDS '
                    'xmlns="https://cdds.io/config" xsi:schemaLocation="a b"><Domain/>'
                    '</CycloneDDS>', ['eth0', 'lo', 'vpn']),
    'gt in a value': ('<CycloneDDS><Domain><Tracing><OutputFile>/tmp/a>b</OutputFile></Tracing>'
                      '</Domain></CycloneDDS>', ['eth0', 'lo', 'vpn']),
}


def written(form: str, tmp_path: Path) -> list[str]:
    """Return URIs with the XML of a form: inline, and in files."""
    text = FORMS[form][0]
    (tmp_path / 'a.xml').write_text(text)
    (tmp_path / 'b.xml').write_text('<!-- <Peer address="1.2.3.4"/> --><CycloneDDS/>')
    # a file has one root of that name, and no short ends
    files = [] if form in ('several', 'ends without a name', 'no ends', 'no root') else [
        f'file://{tmp_path}/a.xml', f'{tmp_path}/a.xml,', f' {tmp_path}/b.xml,\n{tmp_path}/a.xml',
        f'file://{tmp_path}/b.xml, {text}']
    return [text, f'{text} ,', *files]


@pytest.mark.parametrize('form', FORMS)
def test_configuration_is_read_as_cyclone_reads_it(form: str, tmp_path: Path) -> None:
    for uri in written(form, tmp_path):
        found = CYCLONE.robot_interfaces('vpn', 'eth0', {'CYCLONEDDS_URI': uri, 'FOGT_IF': 'lo'})
        assert [one.name for one in sorted(
            found, key=lambda one: -one.priority)] == sorted(FORMS[form][1], key=[
                'lo', 'eth0', 'vpn'].index), uri
        assert CYCLONE.asked({'CYCLONEDDS_URI': uri}) == []


#: Creates a participant for each configuration; each in a domain of its own, whose it is.
CREATE = """
import json, os, sys
from cyclonedds.domain import DomainParticipant
for number, (uri, domain) in enumerate(json.load(sys.stdin)):
    os.environ['CYCLONEDDS_URI'] = uri.replace('Id="7"', 'Id="231"')
    sys.stderr.write(f'\\n@@{number}\\n')
    sys.stderr.flush()
    try:
        DomainParticipant(0 if domain else number + 100)
    except Exception as error:
        sys.stderr.write(f'{type(error).__name__}\\n')
    sys.stderr.flush()
"""


def test_cyclone_reads_our_file_behind_each_form(tmp_path: Path) -> None:
    """Ours asks for an interface that is missing, so a participant is refused if it is read."""
    pytest.importorskip('cyclonedds')
    ours = tmp_path / 'ours.xml'
    ours.write_text(INSIDE.format('<NetworkInterface name="fogtmissing"/>'))
    cases = []
    for form in FORMS:
        folder = tmp_path / form.replace(' ', '-')
        folder.mkdir()
        cases += [(CYCLONE.environment(str(ours), {'CYCLONEDDS_URI': uri})['CYCLONEDDS_URI'],
                   form == 'this domain') for uri in written(form, folder)]
    done = subprocess.run(
        [sys.executable, '-c', CREATE], input=json.dumps(cases), capture_output=True, text=True,
        timeout=120, env={**os.environ, 'FOGT_IF': 'lo'}, cwd=tmp_path)
    blocks = done.stderr.split('\n@@')[1:]
    assert len(blocks) == len(cases)
    for (uri, _), block in zip(cases, blocks):
        assert 'fogtmissing: does not match an available interface' in block, (uri, block)


@pytest.mark.parametrize('uri, address', [
    (f'<CycloneDDS><Domain><Discovery><Peers><{peer}/></Peers></Discovery></Domain></CycloneDDS>',
     '192.168.0.7') for peer in (
         'Peer address="192.168.0.7"', "peer Address = '192.168.0.7:7410'",
         "Peer\n prune_delay='1s' address='192.168.0.7'")])
def test_peers_are_found(uri: str, address: str) -> None:
    user = {'CYCLONEDDS_URI': uri}
    assert CYCLONE.asked(user) == [address]
    assert CYCLONE.robot_interfaces('vpn', 'eth0', user)[0].priority < 0


@pytest.mark.parametrize('uri', ['<CycloneDDS><Domain></CycloneDDS>', '<CycloneDDS a=1/>',
                                 '<CycloneDDS><Domain>&none;</Domain></CycloneDDS>', '<'])
def test_configuration_that_is_no_xml_is_refused(uri: str, tmp_path: Path) -> None:
    (tmp_path / 'a.xml').write_text(uri)
    for place in (uri, f'file://{tmp_path}/a.xml'):
        with pytest.raises(DdsError, match='of CYCLONEDDS_URI is no XML'):
            CYCLONE.robot_interfaces('vpn', None, {'CYCLONEDDS_URI': place})


@pytest.mark.parametrize('interface, name, hint', [
    # Cyclone 0.10: 'selected interface "lo" is not multicast-capable: disabling multicast'
    ('name="lo"', 'lo', 'name="lo" multicast="true"'),
    ('autodetermine="true" multicast="false"', 'an interface',
     'autodetermine="true" multicast="true"'),
    ("address='192.0.2.1' multicast='false'", '192.0.2.1', 'address="192.0.2.1"')])
def test_interface_without_multicast_is_refused(interface: str, name: str, hint: str) -> None:
    uri = INSIDE.format(f'<NetworkInterface {interface}/>')
    with pytest.raises(DdsError, match=f'use {name} without multicast') as refused:
        CYCLONE.robot_interfaces('vpn', None, {'CYCLONEDDS_URI': uri})
    assert hint in refused.value.hint


def test_missing_configuration_is_reported_before_nodes_start() -> None:
    with pytest.raises(DdsError, match='/nowhere/dds.xml'):
        CYCLONE.robot_interfaces('foga1b2c3', None, {'CYCLONEDDS_URI': 'file:///nowhere/dds.xml'})


def test_the_lan_is_the_interface_that_cyclone_would_take() -> None:
    def link(name: str, *flags: str, address: str = '192.0.2.1') -> dict[str, object]:
        return {'ifname': name, 'flags': ['UP', *flags], 'addr_info': [{'local': address}]}

    links = [link('lo', 'LOOPBACK'), link('fogffffff', 'MULTICAST', 'POINTOPOINT'),
             link('tun0', 'POINTOPOINT', 'MULTICAST'), {'ifname': 'eth0', 'flags': ['MULTICAST']},
             {}, link('wlan0', 'MULTICAST'), link('docker0', 'MULTICAST')]
    assert CYCLONE.parse_lan(json.dumps(links)) == 'wlan0'
    assert CYCLONE.parse_lan(json.dumps(links[:4])) is None
    assert CYCLONE.parse_lan('') is None


@pytest.mark.parametrize('text', ['nonsense', '[1]', '7'])
def test_unexpected_output_of_ip_is_an_error(text: str) -> None:
    with pytest.raises(DdsError, match='network interfaces'):
        CYCLONE.parse_lan(text)


def test_this_computers_interfaces_are_read() -> None:
    CYCLONE.parse_lan(process.run(CYCLONE.ask_lan(), timeout=10.0).stdout)


def test_the_receive_buffer_asks_for_no_minimum() -> None:
    assert attributes(rendered(VPN, LOOPBACK), 'SocketReceiveBufferSize') == [
        {'max': '4194304 B'}]


def test_lost_messages_are_repeated_within_milliseconds() -> None:
    """Both sides: the reader that misses something, the writer that asks whether it does."""
    root = rendered(VPN, LOOPBACK)
    assert texts(root, 'NackDelay') == ['2 ms']
    assert texts(root, 'HeartbeatInterval') == ['20 ms']
    assert attributes(root, 'HeartbeatInterval') == [
        {'min': '5 ms', 'minsched': '10 ms', 'max': '1 s'}]
    # each fits into one packet of the VPN
    assert texts(root, 'FragmentSize') == ['1140 B']
    assert texts(root, 'MaxRexmitMessageSize') == ['1240 B']


def test_the_environment_holds_our_file(tmp_path: Path) -> None:
    path = tmp_path / 'a b.xml'
    assert CYCLONE.environment(str(path), {}) == {
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
        'CYCLONEDDS_URI': f'file://{tmp_path}/a b.xml'}


@pytest.mark.parametrize('theirs', [
    'file:///etc/dds.xml', '<CycloneDDS><Domain/></CycloneDDS>', 'file:///etc/dds.xml,'])
def test_the_users_configuration_is_kept_before_ours(theirs: str) -> None:
    environment = CYCLONE.environment('/state/dds.xml', {'CYCLONEDDS_URI': theirs})
    assert environment['CYCLONEDDS_URI'] == f'{theirs.rstrip(",")},file:///state/dds.xml'
    again = CYCLONE.environment('/state/dds.xml', environment)
    assert again == environment


def test_a_path_that_cyclone_would_split_is_refused() -> None:
    with pytest.raises(DdsError, match='comma'):
        CYCLONE.environment('/state/a,b.xml', {})


def test_discovery_that_is_off_is_refused() -> None:
    with pytest.raises(DdsError, match='ROS_AUTOMATIC_DISCOVERY_RANGE'):
        CYCLONE.environment('/state/dds.xml', {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'off'})


def test_robot_with_peers_reaches_them_through_routers() -> None:
    """``DontRoute`` would keep it from computers outside of its LAN."""
    user = {'ROS_STATIC_PEERS': '192.0.2.7'}
    interfaces = CYCLONE.robot_interfaces('foga1b2c3', 'eth0', user)
    assert max(interfaces, key=lambda one: one.priority).name == 'eth0'
    assert texts(rendered(*interfaces), 'DontRoute') == []
