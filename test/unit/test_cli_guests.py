# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog invite``, ``revoke`` and ``join`` over a provider that lives in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import dataclasses
import fcntl
import json
import os
from pathlib import Path
import subprocess
import time
from types import SimpleNamespace
from typing import Any

import pytest
from ros2cli.cli import main

from fogros2.errors import CommandError, FogError, VpnError
from fogros2.model import (
    Command,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    OtherVpn,
    Peer,
    Result,
    to_json,
    VpnInterface,
)
from fogros2.store import (
    delete_folder,
    launch_process,
    OTHER_VPN,
    process_start,
    Record,
    Store,
    this_process,
    write_private,
)
from fogros2.waiting import wait_until
from fogros2_features.guests import invitation, listing, membership, program, provider
from fogros2_testing.fakes import FakeShell, MemoryProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api import endings, progress, reach
from ros2fog_cli.api.reach import Link

OTHER = 'nLDHqcSHfnzLjlrO6PdzdSUWfvrWqPqRUQgyn6lKsjw='
MACHINE = Machine('id', 'planner', 'memory', MachineState.RUNNING, time.time(),
                  Endpoint('ssh', '203.0.113.9'), vpn_host='203.0.113.9', vpn_port=30000)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """Return what the machine is asked; its list of guests has one."""
    instead(monkeypatch, 'fogros2.provider', {'memory': MemoryProvider})
    MemoryProvider.machines = {'id': MACHINE}
    store, interface = Store(), VpnInterface(
        'fogabc123m0', '198.18.7.2', '198.18.7.0/24', 50000, '/run/key')
    store.save(Record(
        'planner', 'memory', MachineSpec('planner', 'memory'), machine_id='id', launch='abc123',
        public_key=OTHER, armed=time.time(), agent_program=__file__, **this_process(),
        vpn=interface, robot_vpn=dataclasses.replace(interface, name='fogabc123')))
    for name, content in (('rmw', 'rmw_cyclonedds_cpp'), ('domain', '7')):
        write_private(store.launch_folder('abc123') / name, content.encode())
    found: list[tuple[str, Any]] = []

    def answer(command: Command) -> Result:
        assert command.sudo
        if command.input == Path(program.__file__).read_bytes():
            assert command.argv[2].startswith('umask 077; target=/run/fogabc123m0.more; ')
            return Result(0, '', '')
        assert command.argv[4:6] == ('/run/fogabc123m0.more', 'fogabc123m0')
        request = json.loads(command.input)
        found.append((command.argv[6], request))
        own = {'key': (request or {}).get('key', OTHER), 'label': 'robot2',
               'address': '198.18.7.224', 'left': 60.0, 'heard': None}
        return Result(0, json.dumps([own] if command.argv[6] != 'remove' else []), '')

    @contextlib.contextmanager
    def session(*arguments: object, **more: object) -> Iterator[FakeShell]:
        yield FakeShell(handlers={'sh': answer})

    monkeypatch.setattr(reach, 'session', session)
    return found


def fog(*words: str) -> Any:
    return main(argv=['fog', *words])


def test_invitation_names_all_that_the_joiner_needs(
    asked: list[tuple[str, Any]], capsys: pytest.CaptureFixture[str], tmp_path: Path,
) -> None:
    second = Store(tmp_path / 'second')
    key = invitation.own_name(second)
    assert fog('invite', 'planner', '--key', key, '--for', '10m') == 0
    text = capsys.readouterr().out.strip()
    found = invitation.unseal(text, invitation.own_key(second))
    assert dataclasses.replace(found, expires=0.0, secret='') == invitation.Invitation(
        'planner', OTHER, '198.18.7.2', '203.0.113.9:30000', '198.18.7.224', '198.18.7.0/24',
        'rmw_cyclonedds_cpp', 7, 0.0, 'fogabc123m0')
    assert 590 < found.expires - time.time() <= 600
    ((verb, request),) = asked
    assert (verb, request['key'], request['seconds'], request['patience']) == (
        'admit', invitation.parse_key(key)[1], 600.0, 180.0)
    assert request['secret'] == found.secret and len(bytes.fromhex(found.secret)) == 32
    assert 0 < request['left'] <= 8 * 3600 and request['door']['port'] == 7399
    assert found.secret not in str(request['door'])
    assert request['addresses'][0] == '198.18.7.224' and len(request['addresses']) == 31
    assert fog('invite', 'planner', '--key', key, '--address', 'robot.example') == 0
    text = capsys.readouterr().out.strip()
    assert invitation.unseal(
        text, invitation.own_key(second)).endpoint == 'robot.example:30000'


def test_machine_that_nobody_can_dial_is_one_clear_error(
    asked: list[tuple[str, Any]], capsys: pytest.CaptureFixture[str],
) -> None:
    MemoryProvider.machines = {'id': dataclasses.replace(
        MACHINE, vpn_host='', robot_host='198.51.100.1')}
    assert "'planner' dials the robot" in fog('invite', 'planner', '--key', OTHER)
    assert capsys.readouterr().out == '' and asked == []


def test_machine_whose_lifetime_is_over_admits_nobody(
    monkeypatch: pytest.MonkeyPatch, asked: list[tuple[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(listing, 'ask', lambda *_: [])  # the program removes such a guest
    assert 'its lifetime is over' in fog('invite', 'planner', '--key', OTHER)
    assert capsys.readouterr().out == ''


@pytest.mark.parametrize('change, words', [
    ({'launch': ''}, 'no launch on this robot'), ({'public_key': ''}, 'no launch on this robot'),
    ({'rmw': 'rmw_zenoh_cpp'}, 'rmw_zenoh_cpp'), ({'key': 'AAAA'}, 'no key')])
def test_what_cannot_be_joined_admits_nobody(
    asked: list[tuple[str, Any]], capsys: pytest.CaptureFixture[str], change: dict[str, str],
    words: str,
) -> None:
    key = change.pop('key', OTHER)
    if 'rmw' in change:
        write_private(Store().launch_folder('abc123') / 'rmw', change.pop('rmw').encode())
    changes: Any = change
    Store().save(dataclasses.replace(Store().load('planner'), **changes))
    assert words in fog('invite', 'planner', '--key', key)
    assert capsys.readouterr().out == '' and asked == []


@pytest.mark.parametrize('who', [(), ('robot2',), ('198.18.7.224',), (OTHER,), (f'x:{OTHER}',)])
def test_guests_are_revoked_by_name_address_or_key(
    asked: list[tuple[str, Any]], capsys: pytest.CaptureFixture[str], who: tuple[str, ...],
) -> None:
    assert fog('revoke', 'planner', *who) == 0
    assert capsys.readouterr().out == 'revoked robot2\n'
    assert asked == [('look', None), ('remove', {'keys': [OTHER]})]


def test_nobody_is_revoked_where_the_vpn_has_ended(
    monkeypatch: pytest.MonkeyPatch, asked: list[tuple[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    def ended(shell: object, record: Record, verb: str, request: object = None) -> None:
        assert verb == 'look'
        raise CommandError(Command(('python3',)), Result(
            1, '', 'Unable to access interface: No such device\nTraceback ...'), "'planner'")

    monkeypatch.setattr(listing, 'ask', ended)
    assert fog('revoke', 'planner') == 0
    assert capsys.readouterr().out == "'planner' has no guests\n"
    assert "'planner' has no guest robot2" in fog('revoke', 'planner', 'robot2')


def test_status_shows_guests_while_the_feature_is_installed(
    asked: list[tuple[str, Any]], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    status = {'since': 0.0, 'rss_kb': 9, 'heartbeat_age': None, 'nodes': []}
    monkeypatch.setattr(reach, 'agent', lambda *_: SimpleNamespace(
        status=lambda timeout: status, close=lambda: None))
    monkeypatch.setattr(reach, 'link', lambda record: Link('198.18.7.2', 'fogabc123'))
    assert fog('status', 'planner', '--json') == 0
    (guest,) = json.loads(capsys.readouterr().out)['guests']
    assert (guest['label'], guest['left'], guest['heard']) == ('robot2', 60.0, None)
    assert fog('status', 'planner') == 0
    table = [line.split() for line in capsys.readouterr().out.splitlines()[-2:]]
    assert table == [['GUEST', 'ADDRESS', 'HEARD', 'MAY', 'JOIN', 'KEY'],
                     ['robot2', '198.18.7.224', 'never', '60', 's', 'more', OTHER]]
    instead(monkeypatch, 'fogros2.feature', {})
    assert fog('status', 'planner', '--json') == 0
    assert 'guests' not in json.loads(capsys.readouterr().out)
    assert asked == [('look', None)] * 2


@pytest.mark.parametrize(('node', 'measured'), [
    ('image_h264_decoder_on_planner', True), ('cloud_pointcloud_encoder-2', True),
    ('wheel_encoder-1', False), ('video_decoder-2', False)])
def test_status_shows_that_it_measures_streams(
    asked: list[tuple[str, Any]], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, node: str, measured: bool,
) -> None:
    measurements = []

    def streams(name: str, **more: object) -> list[object]:
        measurements.append(name)
        deadline = time.monotonic() + 60.0
        while 'measuring streams' not in capsys.readouterr().err:
            assert time.monotonic() < deadline
        return []

    monkeypatch.setattr(progress, 'TICK', 0.01)
    monkeypatch.setattr(progress, 'STILL', 0.01)
    monkeypatch.setattr('ros2fog_cli.api.watching.streams', streams)
    monkeypatch.setattr(reach, 'agent', lambda *_: SimpleNamespace(
        status=lambda timeout: {'nodes': [{'name': node}]}, close=lambda: None))
    monkeypatch.setattr(reach, 'link', lambda record: None)
    assert fog('status', 'planner', '--json') == 0
    assert measurements == ['planner'] * measured


@pytest.mark.parametrize('change', [
    {'label': '\x1b[2J'}, {'key': 'short'}, {'address': '198.18.7.1'}, {'address': '192.0.2.1'},
    {'left': 'long'}, {'left': float('nan')}, {'heard': 'x'}, {'heard': float('inf')}])
def test_machine_that_lies_about_its_guests_is_reported(
    asked: list[tuple[str, Any]], change: dict[str, object],
) -> None:
    guest = {'key': OTHER, 'label': 'a', 'address': '198.18.7.224', 'left': 1.0, 'heard': None}
    for answer in ([{**guest, **change}], [{}], 7):
        text = json.dumps(answer)
        shell = FakeShell(handlers={'sh': lambda c, text=text: Result(0, text, '')})
        with pytest.raises(VpnError, match='invalid list of guests'):
            listing.ask(shell, Store().load('planner'), 'look')


def test_invitations_written_at_once_leave_the_program_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    path = tmp_path / 'fogabc123m0.more'
    monkeypatch.setattr(listing, 'more', lambda interface: str(path))
    command = listing.install(VpnInterface('fogabc123m0', '', '198.18.7.0/24', 0, ''))
    assert command.input is not None
    with subprocess.Popen(command.argv, stdin=subprocess.PIPE) as slow:
        wait_until(lambda: any(tmp_path.iterdir()), timeout=20.0, what='begin')
        subprocess.run(command.argv, input=command.input, check=True)
        slow.communicate(command.input)
    assert slow.returncode == 0 and [*tmp_path.iterdir()] == [path]
    assert path.read_bytes() == command.input and path.stat().st_mode & 0o777 == 0o600


def test_folder_of_a_joined_machine_stays_until_a_reboot(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    store = Store(tmp_path / 'second')
    text = invitation.seal(invitation.Invitation(
        'planner', OTHER, '198.18.7.2', '203.0.113.9:30000', '198.18.7.224', '198.18.7.0/24',
        'rmw_cyclonedds_cpp', 7, time.time() + 60), invitation.public_text(
            invitation.own_key(store)))
    ran: list[Command] = []
    monkeypatch.setattr(membership, 'check_robot', lambda: None)
    monkeypatch.setattr(membership, 'run', lambda commands, **k: ran.extend(commands) or '')
    folder = membership.join(text, store, {})
    assert (folder / 'vpn.key').read_text() == (store.root / 'key').read_text()
    assert f'fog{folder.name}' in (folder / 'dds.xml').read_text()
    assert reach.variables_of(folder)['ROS_DOMAIN_ID'] == '7'
    assert 'Endpoint = 203.0.113.9:30000' in ran[-1].argv[-1]
    key = (store.root / 'key').read_text().strip()
    assert not [word for command in ran for word in command.argv if key in word]
    assert store.other_vpns() == {'planner': folder} and endings.leftovers(store) == []
    process = json.loads((folder / 'process.json').read_text())
    (folder / 'process.json').write_text(json.dumps({**process, 'boot': 'before'}))
    assert endings.leftovers(store) == [folder]

    # the next launch takes over what one that was killed has left, and ends it
    cleared: list[Path] = []
    monkeypatch.setattr(membership, 'is_up', lambda invitation: True)
    monkeypatch.setattr(provider, 'Store', lambda: store)
    monkeypatch.setattr('fogros2.deploy.robot.clear', cleared.append)
    spec = MachineSpec('m', 'joined', options={'invitation': text})
    for ends in ([folder], []):
        with provider.JoinedProvider().join(spec, 'rmw_cyclonedds_cpp', 7, {}):
            assert endings.leftovers(store) == []
        assert cleared == ends
        cleared.clear()  # the folder stays here, and its owner runs


@pytest.mark.parametrize('at_once', [False, True])
def test_launch_leaves_the_vpn_that_others_use(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, at_once: bool,
) -> None:
    """Of another launch that has started at once, or of terminals that have joined meanwhile."""
    store, cleared = Store(tmp_path / 'second'), list[Path]()
    text = invitation.seal(invitation.Invitation(
        'planner', OTHER, '198.18.7.2', '203.0.113.9:30000', '198.18.7.224', '198.18.7.0/24',
        'rmw_cyclonedds_cpp', 7, time.time() + 60), invitation.public_text(
            invitation.own_key(store)))
    monkeypatch.setattr(membership, 'check_robot', lambda: None)
    monkeypatch.setattr(membership, 'run', lambda commands, **k: '')
    monkeypatch.setattr(provider, 'Store', lambda: store)
    monkeypatch.setattr('fogros2.deploy.robot.clear', cleared.append)
    owner = {'pid': os.getppid(), 'pid_start': process_start(os.getppid())}
    if at_once:
        membership.join(text, store, {}, owner=owner)
    ups = iter([False, True] if at_once else [False, False, True])
    monkeypatch.setattr(membership, 'is_up', lambda invitation: next(ups))
    spec = MachineSpec('m', 'joined', options={'invitation': text})
    with provider.JoinedProvider().join(spec, 'rmw_cyclonedds_cpp', 7, {}):
        if not at_once:
            membership.join(text, store, {})
    (folder,) = store.other_vpns().values()
    assert launch_process(folder) == (owner['pid'] if at_once else 1, True) and cleared == []


def test_terminals_that_join_at_once_wait_for_each_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    """One that fails beside another would clear the interface of both."""
    store, alone = Store(tmp_path / 'second'), list[str]()
    text = invitation.seal(invitation.Invitation(
        'planner', OTHER, '198.18.7.2', '203.0.113.9:30000', '198.18.7.224', '198.18.7.0/24',
        'rmw_cyclonedds_cpp', 7, time.time() + 60), invitation.public_text(
            invitation.own_key(store)))

    def note(step: str) -> str:
        other = os.open(store.root / 'launches', os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(other)
        alone.append(step)
        return ''

    monkeypatch.setattr(membership, 'check_robot', lambda: None)
    monkeypatch.setattr(membership, 'is_up', lambda invitation: bool(note('look')))
    monkeypatch.setattr(membership, 'run', lambda commands, **k: note('run'))
    monkeypatch.setattr(membership, 'clear', lambda folder: note('clear'))
    membership.join(text, store, {})
    membership.leave('planner', store)
    assert (alone[:2], alone[-2:]) == (['look', 'run'], ['run', 'clear'])
    # a launch's end
    (folder,) = store.other_vpns().values()
    delete_folder(folder)
    monkeypatch.setattr(membership, 'is_up', lambda invitation: False)
    monkeypatch.setattr(provider, 'Store', lambda: store)
    monkeypatch.setattr('fogros2.deploy.robot.clear', lambda folder: note('end'))
    spec = MachineSpec('m', 'joined', options={'invitation': text})
    with provider.JoinedProvider().join(spec, 'rmw_cyclonedds_cpp', 7, {}):
        pass
    assert alone[-1] == 'end'


def test_invitation_that_fails_leaves_the_former_vpn(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    store = Store(tmp_path / 'second')
    first, second = (invitation.seal(invitation.Invitation(
        'planner', OTHER, '198.18.7.2', '203.0.113.9:30000', '198.18.7.224', '198.18.7.0/24',
        'rmw_cyclonedds_cpp', 7, time.time() + 60, 'foga1b2c3m0', secret), invitation.public_text(
            invitation.own_key(store))) for secret in (32 * 'aa', 32 * 'bb'))
    refusals: list[VpnError] = []

    def run(commands: Iterable[Command], **_: object) -> str:
        if refusals and any(command.what.endswith(' up') for command in commands):
            raise refusals.pop()
        return ''

    monkeypatch.setattr(membership, 'check_robot', lambda: None)
    monkeypatch.setattr(membership, 'run', run)
    folder = membership.join(first, store, {})
    monkeypatch.setattr(membership, 'is_up', lambda invitation: True)
    refusals.append(VpnError('no'))
    with pytest.raises(VpnError, match='no'):
        membership.join(second, store, {})
    assert membership.secret_of(folder) == 32 * 'aa'
    assert membership.join(second, store, {}) == folder
    assert membership.secret_of(folder) == 32 * 'bb'


@pytest.mark.parametrize(('interface', 'error'), [
    ('foga1b2c3m1', "in the VPN of 'mapper' already, by 'planner'.*ros2 fog leave planner "),
    ('fogd4e5f6m0', "the VPN of 'mapper' has the addresses 198.18.7.0/24, and this computer")])
def test_second_machine_of_a_launch_names_the_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, interface: str, error: str,
) -> None:
    """All machines of a launch have one subnet, whatever the pool is."""
    store = Store(tmp_path / 'second')
    first, second = (invitation.seal(invitation.Invitation(
        name, key, '198.18.7.2', '203.0.113.9:30000', '198.18.7.224', '198.18.7.0/24',
        'rmw_cyclonedds_cpp', 7, time.time() + 60, each), invitation.public_text(
            invitation.own_key(store))) for name, key, each in (
                ('planner', OTHER, 'foga1b2c3m0'), ('mapper', f'A{OTHER[1:]}', interface)))
    monkeypatch.setattr(membership, 'check_robot', lambda: None)
    monkeypatch.setattr(membership, 'run', lambda commands, **k: '')
    membership.join(first, store, {})
    monkeypatch.setattr(membership.addresses, 'parse_used', lambda text: ['198.18.7.0/24'])
    with pytest.raises(FogError, match=error):
        membership.join(second, store, {})
    assert [*store.other_vpns()] == ['planner']


def test_leave_names_the_nearest_machine() -> None:
    own = VpnInterface('foga1b2c3', '198.18.7.224', '198.18.7.0/24', 0, '')
    write_private(Store().launch_folder('a1b2c3') / OTHER_VPN, to_json(
        OtherVpn(Peer('slam', '', '198.18.7.2'), own, own, 7224)).encode())
    assert main(argv=['fog', 'leave', 'slan']) == (
        "this computer has not joined a machine 'slan' (did you mean 'slam'?)")
    assert 'ros2 fog join' in main(argv=['fog', 'leave', 'planner'])
