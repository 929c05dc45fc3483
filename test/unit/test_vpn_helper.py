# SPDX-License-Identifier: Apache-2.0
"""What the helper that runs as root takes from its callers, and what callers ask of it."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path
import subprocess
import sys
from types import ModuleType
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
import pytest

from fogros2 import process
from fogros2.deploy import robot
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.model import Command, Peer, Result, VpnInterface
from fogros2.vpn import helped, owner
from fogros2.vpn.wireguard import WireGuard
from ros2fog_cli.api import doctor

FOLDER = Path(__file__).resolve().parents[2] / 'packaging' / 'vpn_helper'
KEY = 'Sg3Q0Y1Y0bZ2v6q0ZkzJbb0pRk3S8u1u4hJ0lWm8VHo='
OTHER = 'qD0Xl0bZ2v6q0ZkzJbb0pRk3S8u1u4hJ0lWm8VHoSg4='
NETWORK = '198.18.7.0/24'


def load() -> ModuleType:
    """Return the program as a module; its folder is no package."""
    spec = importlib.util.spec_from_file_location('vpn_helper', FOLDER / 'vpn.py')
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules['vpn_helper'] = module
    written, path = sys.dont_write_bytecode, list(sys.path)
    spec.loader.exec_module(module)
    sys.dont_write_bytecode, sys.path[:] = written, path
    return module


vpn: Any = load()

#: Values that a caller with bad intent, or a bug, may put anywhere.
BAD = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from([
        'lo', 'eth0', 'fog', 'fogABCDEF', 'fog12345', 'fog1234567', 'fog12345\n', 'fog../..',
        '../fog123456', 'fog12345;', '-h', '', '\0', 'fog12345\u0661', '0.0.0.0/0',
        '198.18.7.0/24 ', '198.18.7.1/24', '198.18.0.0/16', '10.0.0.0/24', '::/24',
        '/etc/shadow', '$(id)', '`id`', "';id;'", '198.18.7.1', '198.18.7.255', 'a:b', 'a b:1',
        'host:0', 'host:65536', 'host:1\nPrivateKey = x', '-x:1', '[::1]', '[::1%]:1',
        '[::1%e;id]:1', '[::1%' + 16 * 'e' + ']:1']),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=6)


#: What takes a value of a caller, and whether the result is harmless.
TAKEN = {
    'name': (lambda value: vpn.name_of(value), lambda name: (
        name.isalnum() and len(name) == 9 and name.startswith('fog'))),
    'network of the pool': (lambda value: vpn.network_of(value, ['198.18.0.0/15']), lambda net: (
        net.startswith(('198.18.', '198.19.')) and net.endswith('.0/24'))),
    'ports of no service': (lambda value: vpn.ports_of(value), lambda ports: all(
        1024 <= first <= last <= 65535 for first, last in ports)),
    'addresses to ask': (lambda value: vpn.asked_of(value), lambda hosts: (
        {*hosts} <= {'192.0.2.7', '198.18.7.1', '198.18.7.255'})),
}


@pytest.mark.parametrize('kind', TAKEN)
@given(value=BAD | st.lists(BAD | st.just('192.0.2.7'), max_size=3))
def test_value_is_harmless_or_refused(kind: str, value: object) -> None:
    take, harmless = TAKEN[kind]
    try:
        taken = take(value)
    except vpn.Refused:
        return
    assert harmless(taken)


@given(st.lists(st.fixed_dictionaries({
    'key': BAD | st.sampled_from([KEY, OTHER]),
    'address': BAD | st.sampled_from(['198.18.7.2', '198.18.7.3']),
    'endpoint': BAD | st.none() | st.just('203.0.113.9:51820')}), max_size=3) | BAD)
def test_no_peer_brings_a_word_of_its_own_into_a_script(value: object) -> None:
    try:
        found = vpn.peers_of(value, NETWORK, '198.18.7.1')
    except vpn.Refused:
        return
    for peer in found:
        assert peer.public_key in (KEY, OTHER)
        assert peer.address in ('198.18.7.2', '198.18.7.3')
        assert peer.endpoint is None or set(peer.endpoint) <= set(
            'abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-:[]')


@given(st.sampled_from(sorted(vpn.FIELDS)), st.binary() | st.builds(
    lambda value: json.dumps(value).encode(), st.dictionaries(
        st.sampled_from(['name', 'pid', 'network', 'port', 'peers', 'x']), BAD, max_size=6)))
def test_a_request_is_whole_or_refused(verb: str, data: bytes) -> None:
    try:
        found = vpn.parse(verb, data)
    except vpn.Refused:
        return
    assert set(found) == vpn.FIELDS[verb]
    assert 'name' not in found or vpn.name_of(found['name']) == found['name']


@pytest.mark.parametrize(('value', 'why'), [
    ([{'key': KEY, 'address': '198.18.7.1', 'endpoint': None}], 'address'),  # the robot's own
    ([{'key': KEY, 'address': '198.18.8.2', 'endpoint': None}], 'address'),
    ([{'key': KEY, 'address': '198.18.7.2', 'endpoint': None}] * 2, 'its own'),
    ([{'key': KEY, 'address': f'198.18.7.{n}', 'endpoint': None} for n in (2, 3)], 'one key'),
    ([{'key': KEY[:-2] + 'B=', 'address': '198.18.7.2', 'endpoint': None}], 'public key'),
    ([{'key': KEY, 'address': '198.18.7.2'}], 'has key'),
    ([{'key': KEY, 'address': '198.18.7.2', 'endpoint': None, 'x': 1}], 'has key'),
    ([{'key': KEY, 'address': '198.18.7.2', 'endpoint': 'a:1\nb'}], 'endpoint'),
    ([{}] * 254, 'up to 253')])
def test_peers_that_are_refused(value: object, why: str) -> None:
    with pytest.raises(vpn.Refused, match=why):
        vpn.peers_of(value, NETWORK, '198.18.7.1')


@pytest.mark.parametrize('value', ['203.0.113.9:1', 'vpn.example.org:65535', '[2001:db8::1]:9',
                                   '[fe80::1%br-lan.2]:9'])
def test_endpoints_as_providers_give_them(value: str) -> None:
    entry = {'key': KEY, 'address': '198.18.7.2', 'endpoint': value}
    (peer,) = vpn.peers_of([entry], NETWORK, '198.18.7.1')
    assert peer == Peer('machine', KEY, '198.18.7.2', value)


@pytest.mark.parametrize('value', [True, 1.0, '1', 0, 65536, None])
def test_a_number_is_one_of_its_range(value: object) -> None:
    with pytest.raises(vpn.Refused):
        vpn.number(value, 1, 65535, 'x')


def test_groups_of_the_lan_are_refused() -> None:
    assert vpn.network_of('10.254.7.0/24', ['10.0.0.0/8']) == '10.254.7.0/24'
    with pytest.raises(vpn.Refused, match="would be the LAN's"):
        vpn.network_of('10.255.0.0/24', ['10.0.0.0/8'])


def test_port_may_change_and_address_may_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(vpn, 'RECORDS', tmp_path)
    monkeypatch.setattr(vpn, 'taken', lambda but: [])
    ran: list[Command] = []
    monkeypatch.setattr(vpn, 'run', lambda commands: ran.extend(commands))
    (tmp_path / 'fog0a1b2c').mkdir()
    vpn.Record('fog0a1b2c', 1000, 0, 0).save(tmp_path / 'fog0a1b2c')
    request = {'name': 'fog0a1b2c', 'network': NETWORK, 'address': '198.18.7.224', 'port': 51820,
               'ports': [[7400, 7649]], 'asked': [], 'peers': []}
    for changes in ({}, {'port': 51821}, {'ports': [[7650, 7899]], 'asked': ['192.0.2.7']}):
        vpn.up({**request, **changes}, 1000)
    assert ['51821' in command.argv[-1] for command in ran] == [False, True, False]
    for changes in ({'address': '198.18.7.225'},
                    {'network': '198.18.8.0/24', 'address': '198.18.8.1'}):
        with pytest.raises(vpn.Refused, match='has another address already'):
            vpn.up({**request, **changes}, 1000)
    assert len(ran) == 3


@pytest.mark.parametrize('change', [
    lambda fields: {**fields, 'domain': 7},
    lambda fields: {key: value for key, value in fields.items() if key != 'asked'}])
def test_record_of_another_version_is_read(tmp_path: Path, change: Any) -> None:
    record = vpn.Record('fog0a1b2c', 1000, 0, 0, NETWORK, '198.18.7.1', 51820, ((7400, 7649),))
    record.save(tmp_path)
    file = tmp_path / 'record'
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
    assert vpn.load(tmp_path) == record


def test_deep_nesting_is_refused() -> None:
    with pytest.raises(vpn.Refused, match='no JSON'):
        vpn.parse('down', b'[' * 100_000)


def test_other_pools_are_the_administrator_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(vpn, 'POOLS', tmp_path / 'pools')
    assert vpn.pools() == ['198.18.0.0/15']
    vpn.POOLS.write_text('# ours\n10.213.0.0/16\n')
    vpn.POOLS.chmod(0o666)
    with pytest.raises(vpn.Refused, match="root's alone"):
        vpn.pools()
    vpn.POOLS.chmod(0o644)
    if os.geteuid() == 0:
        assert vpn.pools() == ['10.213.0.0/16']
        vpn.POOLS.write_text('10.213.0.0/16\nall\n')
        with pytest.raises(vpn.Refused, match='all'):
            vpn.pools()


def test_the_rule_names_each_word_and_nothing_else() -> None:
    text = (FOLDER / 'sudoers').read_text()
    words = [line.split()[1].rstrip(',') for line in text.splitlines()
             if line.startswith('    /usr/libexec')]
    assert set(words) == set(vpn.VERBS) == set(vpn.FIELDS)
    assert '*' not in text and '?' not in text and text.count(helped.HELPER) == len(words)
    assert text.rstrip().endswith(f'%{helped.GROUP} ALL=(root:root) NOPASSWD: FOGROS2_VPN')
    if process.which('visudo'):
        subprocess.run([str(process.which('visudo')), '-q', '-c', '-f', str(FOLDER / 'sudoers')],
                       check=True)


def test_both_sides_mean_the_same() -> None:
    assert str(vpn.PROTOCOL) == helped.PROTOCOL and str(vpn.RECORDS) == helped.KEYS


def test_other_fields_have_another_protocol_number() -> None:
    # an installed helper and a robot of another version compare the number alone
    assert (vpn.PROTOCOL, vpn.FIELDS) == (5, {
        'check': set(), 'keys': {'name', 'pid', 'private'},
        'up': {'name', 'network', 'address', 'port', 'ports', 'asked', 'peers'},
        'peers': {'name', 'peers'}, 'repair': {'name', 'peers'},
        'status': {'name'}, 'down': {'name'}})


# -- the caller's side ---------------------------------------------------------------------------

def interface(key_file: str) -> VpnInterface:
    return VpnInterface('fog0a1b2c', '198.18.7.1', NETWORK, 51820, key_file, firewall=True,
                        process='1')


PEERS = [Peer('first', KEY, '198.18.7.2', '203.0.113.9:51820'), Peer('b', OTHER, '198.18.7.3')]


def test_what_is_asked_of_it_is_what_it_takes() -> None:
    plugin = helped.HelpedWireGuard(((8150, 8399), (7000, 7119)), ['192.0.2.7'])
    made = interface(helped.key_file('fog0a1b2c'))
    commands = [plugin.keys(made), *plugin.up(made, []), *plugin.peers(made, PEERS),
                *plugin.repair(made, PEERS), plugin.status(made), *plugin.down(made)]
    for command, verb in zip(commands, ['keys', 'up', 'peers', 'repair', 'status', 'down']):
        assert command.argv == (helped.HELPER, verb) and command.sudo and command.what
        request = vpn.parse(verb, command.input)
        if verb == 'up':
            record = vpn.Record('fog0a1b2c', 1000, 1, 1, vpn.network_of(
                request['network'], vpn.pools()), vpn.own_address(
                    request['address'], NETWORK), request['port'],
                vpn.ports_of(request['ports']), vpn.asked_of(request['asked']))
            assert record.interface() == made
            assert record.vpn().ports == plugin.ports
            assert record.vpn().asked == plugin.asked
        if 'peers' in request:
            assert [(p.public_key, p.address, p.endpoint) for p in vpn.peers_of(
                request['peers'], NETWORK, '198.18.7.1')] == [
                    (p.public_key, p.address, p.endpoint) for p in PEERS[:len(request['peers'])]]
    assert not plugin.health_check(made).sudo
    lent = helped.lend(made, KEY)
    assert lent.argv == (helped.HELPER, 'keys') and vpn.parse('keys', lent.input) == {
        'name': 'fog0a1b2c', 'pid': 0, 'private': KEY}


@pytest.mark.parametrize('value', ['198.18.8.2', '198.18.7.0', '198.18.7.255', 7, None, 'a'])
def test_own_address_is_one_of_the_network(value: object) -> None:
    assert vpn.own_address('198.18.7.224', NETWORK) == '198.18.7.224'
    with pytest.raises(vpn.Refused, match='one of 198'):
        vpn.own_address(value, NETWORK)


@pytest.mark.usefixtures('name_of_no_text')
def test_name_of_the_caller_may_be_no_text() -> None:
    assert vpn.begun(os.getpid(), os.getuid()) > 0


def test_all_other_interfaces_are_root_s_commands() -> None:
    plugin, plain = helped.HelpedWireGuard(), WireGuard()
    for path in ('/home/eve/.ros/vpn.key', helped.key_file('fogffffff')):
        other = interface(path)
        assert plugin.keys(other) == plain.keys(other)
        assert plugin.status(other) == plain.status(other)
        assert [*plugin.down(other)] == [*plain.down(other)]
        for verb in ('up', 'peers', 'repair'):
            assert [*getattr(plugin, verb)(other, PEERS)] == [*getattr(plain, verb)(other, PEERS)]


@pytest.mark.parametrize(('answer', 'expected'), [
    (Result(0, f'{helped.PROTOCOL}\n', ''), True), (Result(0, '4\n', ''), False),
    (Result(1, '', 'sudo: a password is required'), False)])
def test_it_is_used_where_it_is_permitted(
    monkeypatch: pytest.MonkeyPatch, answer: Result, expected: bool,
) -> None:
    monkeypatch.setattr(helped, 'HELPER', sys.executable)
    monkeypatch.setattr(process, 'which', lambda program: f'/usr/bin/{program}')
    monkeypatch.setattr(process, 'run', lambda command, **more: answer)
    asked = helped.permitted.__wrapped__  # the answer is kept for as long as the process lives
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    assert asked() is expected
    monkeypatch.setattr(os, 'geteuid', lambda: 0)
    assert not asked()
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    monkeypatch.setattr(helped, 'HELPER', '/nowhere/vpn')
    assert not asked()


def test_doctor_asks_root_for_nothing_where_the_helper_is_enough(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    monkeypatch.setattr(process, 'which', lambda program: f'/usr/bin/{program}')
    refused = Result(1, '', 'sudo: a password is required')

    def run(command: Command, *, check: bool = True, **more: object) -> Result:
        if check:
            raise CommandError(command, refused, 'here')
        return refused

    monkeypatch.setattr(process, 'run', run)
    for permitted, verdicts in ((True, ['ok', 'warning', 'warning']),
                                (False, ['failed', 'failed', 'warning'])):
        monkeypatch.setattr(helped, 'permitted', lambda permitted=permitted: permitted)
        found = [doctor.root(), doctor.firewall_program(), doctor.firewall()]
        assert [check.verdict for check in found] == verdicts


@pytest.mark.parametrize(('left', 'permitted', 'helped_down'), [
    ('', True, True), ('0a1b2c/vpn.key', True, False), ('net/fog0a1b2c', True, False),
    ('run/fog0a1b2c', True, True), ('', False, False)])
def test_launch_whose_interface_has_gone_is_cleared_by_its_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: str, permitted: bool,
    helped_down: bool,
) -> None:
    """The timer or a reboot has removed what the helper made; sudo allows the helper alone."""
    folder = tmp_path / '0a1b2c'
    for path in (folder, tmp_path / 'run', tmp_path / 'net'):
        path.mkdir()
    if left:
        (tmp_path / left).touch()
    monkeypatch.setattr(owner, 'INTERFACES', tmp_path / 'net')
    monkeypatch.setattr(helped, 'KEYS', str(tmp_path / 'run'))
    monkeypatch.setattr(helped, 'permitted', lambda: permitted)
    monkeypatch.setattr(robot.ros2_daemon, 'stop', lambda folder: None)
    ran: list[Command] = []
    monkeypatch.setattr(robot, 'run', lambda commands, **more: ran.extend(commands))
    robot.clear(folder)
    assert [command.argv[0] == helped.HELPER for command in ran] == [helped_down]
    assert not folder.exists()


def test_interface_that_goes_while_down_waits_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / 'foga1b2c3'
    folder.mkdir()
    monkeypatch.setattr(vpn, 'RECORDS', tmp_path)
    monkeypatch.setattr(vpn.fcntl, 'flock', lambda *_: folder.rmdir())
    vpn.down({'name': folder.name}, 1000)


def deb() -> Any:
    spec = importlib.util.spec_from_file_location('deb', FOLDER.parent / 'deb.py')
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_package_is_installed_although_its_timer_is_masked(tmp_path: Path) -> None:
    for name, text in {'getent': 'exit 0', 'systemctl': f'echo "$1" >>{tmp_path}/ran; exit 1'
                       }.items():
        (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
        (tmp_path / name).chmod(0o755)
    text = deb().POSTINST.replace('/run/systemd/system', str(tmp_path))
    subprocess.run(['sh', '-c', text, 'postinst', 'configure'], check=True,
                   env={'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    assert (tmp_path / 'ran').read_text().split() == ['daemon-reload', 'start']


def test_package_is_removed_while_another_user_has_an_interface(tmp_path: Path) -> None:
    """``sudo apt purge`` names the administrator; nor does a refusal end the script."""
    helper = tmp_path / 'vpn'
    helper.write_text(f'#!/bin/sh\necho "$(cat) ${{SUDO_UID-root}}" >>{tmp_path}/said; exit 2\n')
    helper.chmod(0o755)
    records = tmp_path / 'run/fogros2-vpn'
    for name in ('fog0a1b2c', 'fog0a1b2d'):
        (records / name).mkdir(parents=True)
    text = deb().PRERM.replace('/run/', f'{tmp_path}/run/').replace(helped.HELPER, str(helper))
    subprocess.run(['sh', '-c', text, 'prerm', 'remove'], check=True, stderr=subprocess.DEVNULL,
                   env={**os.environ, 'SUDO_UID': '1000'})
    assert (tmp_path / 'said').read_text().splitlines() == [
        '{"name": "fog0a1b2c"} root', '{"name": "fog0a1b2d"} root']
    assert not records.exists()


def test_kernel_with_wireguard_needs_no_tun(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    monkeypatch.setattr(robot, 'TUN', tmp_path / 'tun')
    monkeypatch.setattr(process, 'require', lambda *_, **__: None)
    monkeypatch.setattr(os, 'geteuid', lambda: 0)
    monkeypatch.setattr(robot, 'kernel_wireguard', lambda: True)
    robot.check_robot()
    monkeypatch.setattr(robot, 'kernel_wireguard', lambda: False)
    with pytest.raises(PrerequisiteError, match='--device /dev/net/tun'):
        robot.check_robot()


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can give up a right')
def test_container_without_net_admin_is_refused_at_once() -> None:
    text = ('from fogros2.deploy import check_robot; from ros2fog_cli.api import doctor\n'
            'print(doctor.firewall_program()); check_robot()')
    child = subprocess.run(['setpriv', '--bounding-set=-net_admin', sys.executable, '-c', text],
                           capture_output=True, text=True)
    remedy = f'start the container with --cap-add NET_ADMIN --device {robot.TUN}'
    assert remedy in child.stdout and 'modprobe' not in child.stdout
    assert 'needs NET_ADMIN' in child.stderr and remedy in child.stderr


def test_user_outside_of_the_group_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, 'which', lambda program: f'/usr/bin/{program}')
    monkeypatch.setattr(process, 'sudo_trouble', lambda: process.PASSWORD)
    with pytest.raises(PrerequisiteError) as caught:
        robot.check_sudo()
    assert 'install the helper' in caught.value.hint
    monkeypatch.setattr(helped, 'HELPER', sys.executable)
    with pytest.raises(PrerequisiteError) as caught:
        robot.check_sudo()
    assert 'install the helper again' in caught.value.hint  # it may be of another version
    assert 'group fogros2' in caught.value.hint


def test_launch_that_ends_while_its_interface_waits_gets_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """``tidy`` has passed it by then, and nothing would take the interface away."""
    monkeypatch.setattr(vpn, 'RECORDS', tmp_path)
    monkeypatch.setattr(vpn, 'taken', lambda but: [])
    ran: list[Command] = []
    monkeypatch.setattr(vpn, 'run', lambda commands: ran.extend(commands))
    (tmp_path / 'fog0a1b2c').mkdir()
    child = subprocess.Popen(['true'])
    child.wait()
    vpn.Record('fog0a1b2c', os.getuid(), child.pid, 1).save(tmp_path / 'fog0a1b2c')
    with pytest.raises(vpn.Refused, match='the launch of fog0a1b2c, process .* has ended'):
        vpn.up({'name': 'fog0a1b2c', 'network': NETWORK, 'address': '198.18.7.1', 'port': 51820,
                'ports': [], 'asked': [], 'peers': []}, os.getuid())
    assert ran == []
