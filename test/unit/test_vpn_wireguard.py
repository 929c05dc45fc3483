# SPDX-License-Identifier: Apache-2.0
"""The commands of WireGuard, by value: no interface is made here."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import subprocess
import tempfile

import pytest

from fogros2.dds import DdsVendor
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds
from fogros2.dds.zenoh import Zenoh
from fogros2.errors import ConfigurationError, VpnError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.vpn import owner
from fogros2.vpn.wireguard import WireGuard

KEY = 'nLDHqcSHfnzLjlrO6PdzdSUWfvrWqPqRUQgyn6lKsjw='
OTHER = 'Kg7ZbFqs9cU1UuPHc9zzQUoyo+MdSEgx7xQ7iDqIexk='
ROBOT = VpnInterface(
    'foga1b2c3', '198.18.7.1', '198.18.7.0/24', 40000, '/state/vpn.key', firewall=True)
MACHINE = dataclasses.replace(
    ROBOT, name='foga1b2c3m0', address='198.18.7.2', firewall=False, key_file="/run/it's/vpn.key")
TO_MACHINE = Peer('planner', KEY, '198.18.7.2', '203.0.113.9:50000')
TO_ROBOT = Peer('robot', OTHER, '198.18.7.1')


def every_command(interface: VpnInterface, peer: Peer) -> list[Command]:
    wireguard = WireGuard()
    return [
        wireguard.keys(interface), *wireguard.up(interface, [peer]),
        *wireguard.peers(interface, [peer]), wireguard.health_check(interface),
        *wireguard.repair(interface, [peer]), wireguard.status(interface),
        *wireguard.down(interface)]


def script(*commands: Command) -> str:
    return '\n'.join(command.argv[-1] for command in commands)


@pytest.mark.parametrize('interface, peer', [(ROBOT, TO_MACHINE), (MACHINE, TO_ROBOT)])
def test_every_script_is_one_that_sh_reads(interface: VpnInterface, peer: Peer) -> None:
    for command in every_command(interface, peer):
        if command.argv[0] == 'sh':
            subprocess.run(['sh', '-n', '-c', command.argv[-1]], check=True)


def test_all_but_looking_needs_root() -> None:
    looks = WireGuard().health_check(ROBOT)
    assert not looks.sudo
    assert all(c.sudo for c in every_command(ROBOT, TO_MACHINE) if c != looks)


def test_kernel_without_fib_or_socket_takes_the_filter() -> None:
    """As WSL's was until 6.6.114: only the DDS of the launch's processes is not filtered there."""
    robot = dataclasses.replace(ROBOT, process='1')
    filters, confined = script(*WireGuard([(7400, 7649)]).up(robot, [])).split('confine() {')
    for rule in ('fib saddr', 'socket cgroupv2'):
        assert rule not in filters and rule in confined


def test_full_disk_is_the_reason_that_the_key_is_not_written(tmp_path: Path) -> None:
    """``wg genkey`` ends well there, and ``wg pubkey`` would speak of the key's length."""
    (tmp_path / 'wg').write_text('#!/bin/sh\n')
    (tmp_path / 'wg').chmod(0o755)
    key = tmp_path / 'launch/vpn.key'
    command = WireGuard().keys(dataclasses.replace(ROBOT, key_file=str(key)))
    done = subprocess.run(command.argv, capture_output=True, text=True, env={
        **os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    assert done.returncode != 0 and not [*key.parent.iterdir()]
    assert done.stderr.strip() == f"{key} can't be written: is the disk full?"


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can act as another user')
def test_folder_that_root_may_not_enter_has_a_remedy_and_no_key(tmp_path: Path) -> None:
    """Such as a home on NFS; here, another user takes the part of root."""
    interface = dataclasses.replace(ROBOT, key_file=str(tmp_path / 'launch/vpn.key'))
    tmp_path.chmod(0o700)
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / 'nft').symlink_to('/bin/true')
        Path(name).chmod(0o755)
        keys, down = (subprocess.run(
            command.argv, user=65534, capture_output=True, text=True,
            env={'PATH': f'{name}:/usr/bin:/bin'})
            for command in (WireGuard().keys(interface), *WireGuard().down(interface)))
    assert keys.returncode == 1 and 'FOGROS2_STATE_HOME' in keys.stderr.splitlines()[-1]
    assert (down.returncode, down.stderr) == (0, '')


def test_filter_exists_before_and_after_the_interface() -> None:
    up, down = script(*WireGuard().up(ROBOT, [])), script(*WireGuard().down(ROBOT))
    assert up.index('nft -f') < up.index('ip link add') < up.index('wg syncconf')
    assert down.index('ip link delete') < down.index('nft -f') < down.index('rm -f /state/vpn.key')


def test_robot_sends_to_the_hosts_that_the_user_names() -> None:
    robot = dataclasses.replace(ROBOT, process='77')
    text = script(*WireGuard(FastDds().ports, ['192.0.2.7']).up(robot, []))
    assert 'ip daddr { 239.255.0.1, 239.18.7.1, 192.0.2.7 } accept' in text
    assert 'pid=77\n' in text


def test_groups_of_the_vpn_leave_the_robot_by_the_vpn_only() -> None:
    text = script(*WireGuard().up(ROBOT, []))
    rules = [text.index(rule) for rule in (
        f'oifname "{ROBOT.name}" accept', 'ip daddr 239.18.7.1 ip ttl set 0 accept',
        'ip daddr 239.18.7.0/24 drop')]
    assert rules == sorted(rules)
    assert 'ip daddr != { 198.18.7.1, 239.255.0.1, 239.18.7.1 } drop' in text


def confining(interface: VpnInterface, folder: Path) -> str:
    """Return the step that confines a process, with a folder in place of the system's."""
    text = script(*WireGuard().up(interface, []))
    text = text[text.index('empty_group() {'):text.index('[ -e /sys/class/net')]
    for path in ('/proc/', '/sys/fs/cgroup', '/run/'):
        text = text.replace(path, f'{folder}{"/" * path.endswith("/")}')
    return text


@pytest.mark.parametrize('odd', ['/a" accept; #', '/a/../b', '/a b', '/a$(id)', '/a\\"'])
def test_group_with_an_odd_name_enters_no_rule(tmp_path: Path, odd: str) -> None:
    (tmp_path / '77').mkdir()
    (tmp_path / '77/cgroup').write_text(f'0::{odd}\n')
    (tmp_path / 'cgroup.procs').touch()
    text = confining(dataclasses.replace(ROBOT, process='77'), tmp_path)
    said = subprocess.run(['sh', '-ec', text], capture_output=True, text=True, check=True).stdout
    assert said.startswith('no control group for process 77: odd name: /a')
    assert not list(tmp_path.glob('a*'))


@pytest.mark.parametrize('vendor', [CycloneDds, FastDds, Zenoh])
def test_ports_of_the_last_domain_exist(vendor: type[DdsVendor]) -> None:
    assert max((last for _, last in vendor(232).ports), default=0) <= 65535


@pytest.mark.parametrize(('words', 'members'), [('agent.py serve', ['5', '77']), ('init', ['77'])])
def test_parent_that_starts_an_agent_again_is_confined(
    tmp_path: Path, words: str, members: list[str],
) -> None:
    for number, line in (('77', 'agent.py serve'), ('5', words)):
        (tmp_path / number).mkdir()
        (tmp_path / number / 'cmdline').write_text(line)
    (tmp_path / '77/status').write_text('Pid:\t77\nPPid:\t5\n')
    (tmp_path / '77/cgroup').write_text('0::/a\n')
    (tmp_path / 'cgroup.procs').touch()
    (tmp_path / 'agent.pid').write_text('77\n')
    group = tmp_path / 'a' / MACHINE.name
    group.mkdir(parents=True)
    moved = group / 'cgroup.procs'
    moved.touch()
    machine = dataclasses.replace(MACHINE, process=str(tmp_path / 'agent.pid'))
    text = confining(machine, tmp_path).replace('| nft -f -', '>/dev/null')
    # a control group takes one process after the other
    text = text.replace('>"$top$group/cgroup.procs"', f'>>"{moved}"')
    said = subprocess.run(['sh', '-ec', text], capture_output=True, text=True, check=True).stdout
    assert said == '' and moved.read_text().split() == members


@pytest.mark.parametrize('domain, ports', [(0, '7400-7649'), (5, '8650-8899')])
def test_the_filter_lets_in_the_ports_of_the_ros_domain(domain: int, ports: str) -> None:
    text = script(*WireGuard(CycloneDds(domain).ports).up(ROBOT, []))
    assert f'udp dport {{ {ports} }} accept' in text
    text = next(WireGuard(FastDds(domain).ports).up(ROBOT, [])).argv[-1]
    assert f'udp dport {{ {ports}, 7000-7119 }} accept' in text


def test_a_launch_with_zenoh_lets_nothing_in() -> None:
    text = script(*WireGuard(Zenoh(domain=3).ports).up(
        dataclasses.replace(ROBOT, process='1'), []))
    assert 'dport' not in text and 'icmp type echo-request accept' in text


def test_peers_get_their_address_and_group_one_the_common_one() -> None:
    other = Peer('tracker', OTHER, '198.18.7.3')
    text = script(*WireGuard().peers(ROBOT, [TO_MACHINE, other]))
    assert (f"'PublicKey = {KEY}' 'AllowedIPs = 198.18.7.2/32, 239.18.7.2/32, 239.255.0.1/32'"
            in text)
    assert f"'PublicKey = {OTHER}' 'AllowedIPs = 198.18.7.3/32, 239.18.7.3/32'" in text
    assert "'Endpoint = 203.0.113.9:50000'" in text
    assert "'PersistentKeepalive = 25'" in text


@pytest.mark.parametrize(('endpoint', 'host'), [
    ('198.51.100.7:51820', '198.51.100.7'), ('[2001:db8::1]:51820', '2001:db8::1'),
    ('[fe80::1%eth0]:1', 'fe80::1%eth0'), ('(none)', '')])
def test_endpoints_are_read_from_the_output_of_wg(
    tmp_path: Path, endpoint: str, host: str,
) -> None:
    """The robot notes from which of its addresses packets to a machine leave."""
    for name, said in (('wg', f'{KEY}\t{endpoint}'), ('ip', 'local 1 dev x src 192.0.2.1 uid 0')):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\ncat >>{tmp_path}/{name}.in; echo "{said}"\n')
        program.chmod(0o755)
    wireguard = WireGuard()
    noted = str(tmp_path / 'noted')
    key = dataclasses.replace(ROBOT, key_file='/dev/null')
    for command in (*wireguard.peers(key, []), wireguard.health_check(key)):
        text = command.argv[-1].replace('/run/foga1b2c3.noted', noted)
        begin = text.index('ask=' if 'ask=' in text else '[ ! -e')
        done = subprocess.run(
            ['sh', '-c', text[begin:]], capture_output=True, text=True,
            env={'PATH': f'{tmp_path}:/usr/bin:/bin'})
        assert done.returncode == 0, done
    asked = f'route get {host}\n' if host else '\n'
    assert Path(noted).read_text() == f'# 192.0.2.1\n{asked}'
    assert (tmp_path / 'ip.in').read_text() == asked * 2


def test_machine_writes_endpoints_when_they_change(tmp_path: Path) -> None:
    """Of a container machine, /run is on the disk of its host."""
    program, noted = tmp_path / 'wg', tmp_path / 'noted'
    text = WireGuard().health_check(MACHINE).argv[-1].replace('/run/foga1b2c3m0.noted', str(noted))

    def check(endpoints: str, status: int = 0) -> int:
        program.write_text(f'#!/bin/sh\nprintf "%s" "{endpoints}"\nexit {status}\n')
        program.chmod(0o755)
        subprocess.run(['sh', '-ec', text[text.index('found='):]], check=True, env={
            'PATH': f'{tmp_path}:/usr/bin:/bin'})
        assert status or noted.read_text().rstrip() == endpoints.rstrip()
        return noted.stat().st_mtime_ns

    first = check(two := f'{KEY}\t192.0.2.1:1\n{OTHER}\t(none)\n')
    assert check(two) == first
    assert check('', status=1) == first
    assert check(f'{KEY}\t192.0.2.1:1\n') != first and check('') != first


@pytest.mark.parametrize('change', [
    {'public_key': f'{KEY}\nAllowedIPs = 0.0.0.0/0'}, {'public_key': ''},
    {'address': '0.0.0.0/0'}, {'address': '198.18.7.2\n'},
    {'endpoint': '203.0.113.9:1\nAllowedIPs = 0.0.0.0/0'}, {'endpoint': 'nowhere'}])
def test_what_a_machine_says_of_itself_cant_say_more(change: dict[str, str]) -> None:
    with pytest.raises(VpnError, match='of planner is '):
        list(WireGuard().peers(ROBOT, [dataclasses.replace(TO_MACHINE, **change)]))


@pytest.mark.parametrize('endpoint', [
    'host.example.org:1', '[2001:db8::1]:51820', '[fe80::1%br-lan]:1'])
def test_endpoints_may_be_names_and_ipv6(endpoint: str) -> None:
    peer = dataclasses.replace(TO_MACHINE, endpoint=endpoint)
    assert f"'Endpoint = {endpoint}'" in script(*WireGuard().peers(ROBOT, [peer]))


@pytest.mark.parametrize('name', ['', 'fog a', 'fog;id', 'fogaaaaaaaaaaaaa', '0fog'])
def test_interfaces_without_a_proper_name_are_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match='name a VPN interface'):
        list(WireGuard().up(dataclasses.replace(ROBOT, name=name), []))


def test_status_asks_for_nothing_secret_and_is_understood() -> None:
    wireguard = WireGuard()
    assert 'dump' not in script(wireguard.status(ROBOT))
    text = f'{KEY}\t1700000000\n{OTHER}\t0\n{KEY}\t100\t200\n{OTHER}\t0\t148\n'
    assert wireguard.parse_status(text) == {
        KEY: {'handshake': 1700000000.0, 'received': 100.0, 'sent': 200.0},
        OTHER: {'handshake': 0.0, 'received': 0.0, 'sent': 148.0}}
    assert wireguard.parse_status('') == {}


@pytest.mark.parametrize('text', [f'{KEY}\tnever\n', f'{KEY}\t1\t2\t3\n', f'{KEY}\n'])
def test_status_that_isnt_wireguards_is_an_error(text: str) -> None:
    with pytest.raises(VpnError, match='counters'):
        WireGuard().parse_status(text)


def test_machine_without_tun_is_reported(tmp_path: Path) -> None:
    """A pod has no such device, and some runtimes let nobody make it."""
    for name in ('wg', 'ip', 'mknod', 'wireguard-go', 'nft'):
        program = tmp_path / name
        program.write_text('#!/bin/sh\n' if name == 'nft' else
                           f'#!/bin/sh\necho "{name} refuses" >&2\nexit 1\n')
        program.chmod(0o755)
    command, = WireGuard().up(MACHINE, [TO_ROBOT])
    text = command.argv[-1].replace('/dev/net', str(tmp_path / 'net'))
    told = subprocess.run(['sh', '-ec', text], capture_output=True, text=True,
                          env={'PATH': f'{tmp_path}:/usr/bin:/bin'})
    assert told.returncode == 1
    assert told.stderr.splitlines()[-1] == (
        'no WireGuard in this kernel (ip refuses), and no '
        f'{tmp_path}/net/tun nor the right to make it')


@pytest.mark.parametrize(('error', 'dead'), [
    (PermissionError, []), (ProcessLookupError, ['a1b2c3'])])
def test_launch_that_hidepid_hides_is_not_dead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[OSError], dead: list[str],
) -> None:
    def kill(pid: int, number: int) -> None:
        raise error

    (tmp_path / ROBOT.name).mkdir()
    (tmp_path / ROBOT.name / 'ifalias').write_text(owner.note(ROBOT).argv[-1])
    monkeypatch.setattr(owner, 'INTERFACES', tmp_path)
    monkeypatch.setattr('fogros2.store.process_start', lambda pid: None)
    monkeypatch.setattr(owner, 'process_start', lambda pid: None)
    monkeypatch.setattr(os, 'kill', kill)
    assert owner.abandoned() == dead


def test_robot_forwards_nothing_between_vpn_and_other_networks() -> None:
    """It may be a router, of containers say, and may masquerade what it forwards."""
    text = script(*WireGuard().up(ROBOT, []))
    chain = text[text.index('chain forward {'):text.index('chain groups {')]
    for direction in ('iifname', 'oifname'):
        assert f'{direction} "{ROBOT.name}" drop' in chain
