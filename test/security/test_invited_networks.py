# SPDX-License-Identifier: Apache-2.0
"""An invitation takes no address of the internet from the computer that it is pasted into."""

from __future__ import annotations

from collections.abc import Mapping
import ipaddress
import json
from pathlib import Path
import time
from typing import Any

import pytest

from fogros2.errors import ConfigurationError
from fogros2.model import Command
from fogros2.store import (
    boot_id,
    delete_folder,
    process_start,
    Store,
    this_process,
    write_private,
)
from fogros2_features.guests import invitation, membership
from fogros2_features.guests.invitation import Invitation
from ros2fog_cli import verb

KEY = 'nLDHqcSHfnzLjlrO6PdzdSUWfvrWqPqRUQgyn6lKsjw='


def text(
    store: Store, network: str, monkeypatch: pytest.MonkeyPatch,
    endpoint: str = '203.0.113.9:30000',
) -> str:
    """Return an invitation that another program wrote, for a network."""
    first = ipaddress.IPv4Network(network, strict=False).network_address
    monkeypatch.setattr(invitation, 'to_json', json.dumps)
    content: Any = {
        'machine': 'planner', 'key': KEY, 'address': str(first + 2),
        'endpoint': endpoint, 'joiner': str(first + 1), 'network': network,
        'rmw': 'rmw_cyclonedds_cpp', 'domain': 7, 'expires': time.time() + 60}
    return invitation.seal(content, invitation.public_text(invitation.own_key(store)))


class Robot:
    """A computer that joins; ``ran`` are the commands of root that it would run."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.store, self.ran, self.asked = Store(folder), list[Command](), list[str]()
        self.monkeypatch = monkeypatch
        monkeypatch.setattr(membership, 'check_robot', lambda: None)
        monkeypatch.setattr(
            membership, 'run', lambda commands, **_: self.ran.extend(commands) or '')

    def join(
        self, network: str, *, endpoint: str = '203.0.113.9:30000',
        environment: Mapping[str, str] = {}, **options: Any,
    ) -> None:
        with self.monkeypatch.context() as patch:
            written = text(self.store, network, patch, endpoint)
        membership.join(written, self.store, environment, **options)

    def agree(self, question: str) -> bool:
        self.asked.append(question)
        return True


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(tmp_path / 'state', monkeypatch)


@pytest.mark.parametrize('network', [
    '8.8.8.0/24', '140.0.0.0/24', '172.32.0.0/24', '100.128.0.0/24', '198.20.0.0/24',
    '9.9.9.8/30'])
def test_public_addresses_are_taken_only_after_a_question(robot: Robot, network: str) -> None:
    with pytest.raises(ConfigurationError, match=f'take the public addresses {network}'):
        robot.join(network)
    assert robot.ran == [] and robot.store.other_vpns() == {}
    robot.join(network, agreed=robot.agree)
    assert network in robot.asked[0] and 'public addresses' in robot.asked[0]
    assert 'planner' in robot.store.other_vpns()


@pytest.mark.parametrize('network', [
    '140.0.0.0/8', '10.0.0.0/8', '0.0.0.0/0', '128.0.0.0/1', '198.18.0.0/23', '127.0.0.0/24',
    '169.254.169.0/24', '224.0.0.0/24', '255.255.255.0/24'])
def test_network_that_no_launch_has_is_refused(robot: Robot, network: str) -> None:
    with pytest.raises(ConfigurationError, match='this is no invitation: '):
        robot.join(network, agreed=robot.agree)
    assert robot.ran == [] and robot.asked == []


@pytest.mark.parametrize('network', [
    '198.18.7.0/24', '10.213.4.0/24', '172.31.0.0/24', '192.168.78.0/24', '100.64.1.0/24'])
def test_private_addresses_need_no_question(robot: Robot, network: str) -> None:
    robot.join(network)
    assert robot.ran and robot.asked == []


def test_joining_takes_no_vpn_away_that_is_used(
    robot: Robot, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(membership, 'clear', delete_folder)
    robot.join('198.18.7.0/24', owner=this_process())
    (first,) = robot.store.other_vpns().values()
    with pytest.raises(ConfigurationError, match="a launch here uses another machine 'planner'"):
        robot.join('198.18.8.0/24')
    by_hand = {'pid': 1, 'pid_start': process_start(1) or 0, 'boot': boot_id()}
    write_private(first / 'process.json', json.dumps(by_hand).encode())
    with pytest.raises(ConfigurationError, match="has joined another machine 'planner'") as raised:
        robot.join('198.18.8.0/24', endpoint='203.0.113.10:30000')
    assert raised.value.hint.startswith('ros2 fog leave planner ')
    assert list(robot.store.other_vpns().values()) == [first]
    robot.join('198.18.8.0/24')
    (second,) = robot.store.other_vpns().values()
    assert second != first and not first.exists(), 'the same machine, of a later launch'
    write_private(second / 'process.json', json.dumps({**this_process(), 'pid_start': 1}).encode())
    robot.join('198.18.9.0/24', endpoint='203.0.113.10:30000')
    assert not second.exists(), 'of a launch that died'


def test_port_of_the_robot_is_left_to_its_own_vpn(robot: Robot) -> None:
    robot.join('198.18.7.0/24', environment={'FOGROS2_VPN_PORT': '45678'})
    script = robot.ran[-1].argv[-1]
    assert 'ListenPort = ' in script and 'ListenPort = 45678' not in script


@pytest.mark.parametrize('network', [7, None, ['198.18.7.0/24'], '198.18.7.0/24\n'])
def test_network_that_is_no_text_is_refused(network: Any) -> None:
    with pytest.raises(ValueError):
        Invitation('planner', KEY, '198.18.7.2', '203.0.113.9:30000', '198.18.7.1', network,
                   'rmw_cyclonedds_cpp', 7, time.time() + 60)


def test_question_is_not_in_what_a_shell_evaluates(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As ``ros2 fog join`` prints lines for ``eval``."""
    assert not verb.confirmed('Take 8.8.8.0/24?'), 'nobody is asked without a terminal'
    monkeypatch.setattr('sys.stdin.isatty', lambda: True)
    monkeypatch.setattr('builtins.input', lambda: 'y')
    assert verb.confirmed('Take 8.8.8.0/24?')
    out, err = capsys.readouterr()
    assert out == '' and err == 'Take 8.8.8.0/24? [y/N] '
