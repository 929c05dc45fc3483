# SPDX-License-Identifier: Apache-2.0
"""
A robot that is a copy of another one's disk leaves the other's machines alone.

Both have the same host name, user id and state folder, here also the same machine-id.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from pathlib import Path
import shutil
from typing import Any

import pytest
from ros2cli.cli import main

from fogros2 import store
from fogros2.deploy.steps.creating import Creation
from fogros2.errors import NameTaken
from fogros2.model import MachineSpec
from fogros2.store import robot_name, Store
from fogros2_testing.fakes import FakeProvider, FakeVpn
from fogros2_testing.plugins import instead
from rigs.deploying import job
from ros2fog_cli.api import machines

SPEC = MachineSpec('slam', 'fake')
#: The launch's process, seen from another computer: none.
ELSEWHERE = {'pid': 1, 'pid_start': 1, 'boot': 'another'}


@pytest.fixture
def provider(monkeypatch: pytest.MonkeyPatch) -> FakeProvider:
    fake = FakeProvider()

    def plugin() -> FakeProvider:
        return fake

    plugin.configured = lambda: True  # type: ignore[attr-defined]
    plugin.capabilities = FakeProvider.capabilities  # type: ignore[attr-defined]
    instead(monkeypatch, 'fogros2.provider', {'fake': plugin})
    instead(monkeypatch, 'fogros2.vpn', {'wireguard': FakeVpn})
    return fake


@pytest.fixture
def boot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function that makes this process the robot with a MAC address."""
    first = tmp_path / '02:00:00:00:00:01'
    first.mkdir()

    def boot(mac: str) -> None:
        disk = tmp_path / mac
        if not disk.exists():
            shutil.copytree(first, disk)
        monkeypatch.setenv('FOGROS2_STATE_HOME', str(disk / 'state'))
        monkeypatch.setenv('XDG_CONFIG_HOME', str(disk / 'config'))
        monkeypatch.setattr(store, 'mac_addresses', lambda: [mac], raising=False)

    boot(first.name)
    return boot


def launched(on_exit: Any = 'delete', **changes: Any) -> None:
    """Create a machine, as a launch of this robot that goes on elsewhere."""
    context, mine = job(Store().root, dataclasses.replace(SPEC, on_exit=on_exit),
                        provider=machines.load('fake'))
    Creation(context, mine).run()
    mine.save(**ELSEWHERE, **changes)


def test_clone_collects_and_deletes_nothing(
    provider: FakeProvider, boot: Callable[[str], None],
) -> None:
    launched()
    boot('02:00:00:00:00:02')
    assert main(argv=['fog', 'gc']) == 0
    assert main(argv=['fog', 'delete', 'all', '--yes']) == 0
    assert len(list(provider.find({}))) == 1
    boot('02:00:00:00:00:01')
    assert main(argv=['fog', 'gc']) == 0
    assert list(provider.find({})) == []


def test_clone_does_not_take_a_machine(
    provider: FakeProvider, boot: Callable[[str], None],
) -> None:
    launched()
    boot('02:00:00:00:00:02')
    with pytest.raises(NameTaken, match=f'belongs to the robot {robot_name()}-'):
        launched()
    assert 'destroy' not in provider.calls


def test_renamed_robot_keeps_its_machines(
    provider: FakeProvider, boot: Callable[[str], None], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    launched('keep')
    monkeypatch.setattr(store, 'robot_name', lambda: 'renamed-1000')
    launched('keep')
    assert provider.calls.count('create') == 1
    shutil.rmtree(Store().root)
    assert main(argv=['fog', 'list']) == 0
    assert '(orphan)' in capsys.readouterr().out
    assert main(argv=['fog', 'delete', 'all', '--yes']) == 0
    assert list(provider.find({})) == []


def test_delete_with_a_copied_record_needs_force(
    provider: FakeProvider, boot: Callable[[str], None],
) -> None:
    """Only the other computer knows whether a launch uses the machine."""
    launched()
    boot('02:00:00:00:00:02')
    assert 'belongs to the robot' in str(main(argv=['fog', 'delete', 'slam', '--yes']))
    assert len(list(provider.find({}))) == 1
    assert main(argv=['fog', 'delete', 'slam', '--yes', '--force']) == 0
    assert list(provider.find({})) == []


def test_id_stays_without_a_state_folder(
    provider: FakeProvider, boot: Callable[[str], None], capsys: pytest.CaptureFixture[str],
) -> None:
    launched()
    shutil.rmtree(Store().root)
    assert main(argv=['fog', 'list']) == 0
    assert '(orphan)' in capsys.readouterr().out


def test_mac_address_of_hardware_comes_first(tmp_path: Path) -> None:
    for name, address, kind in (
            ('br0', '02:00:00:00:00:0b', '3'), ('tap0', '02:00:00:00:00:0c', '3'),
            ('lo', '00:00:00:00:00:00', '0'), ('eth1', '02:00:00:00:00:0a', '0'),
            ('fog1', '', '0'),
            ('wlan0', '02:00:00:00:00:09', '3')):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'address').write_text(f'{address}\n')
        (tmp_path / name / 'addr_assign_type').write_text(kind)
    for name in ('eth1/device', 'wlan0/device', 'br0/bridge'):
        (tmp_path / name).mkdir()
    assert store.mac_addresses(tmp_path) == [
        f'02:00:00:00:00:{end}' for end in ('0a', '09', '0c', '0b')]
