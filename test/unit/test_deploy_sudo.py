# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.deploy where sudo begins to want a password in the middle of a launch."""

from __future__ import annotations

from pathlib import Path

import pytest

from fogros2 import process
from fogros2.deploy import Launch
from fogros2.model import Command
from fogros2.report import Event, StepFailed
from fogros2.store import Store
from fogros2_testing.fakes import FakeVpn
from fogros2_testing.plugins import instead
from ros2fog_cli.api import endings


@pytest.fixture
def events() -> list[Event]:
    return []


@pytest.fixture
def launch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, events: list[Event]) -> Launch:
    instead(monkeypatch, 'fogros2.vpn', {'wireguard': FakeVpn})
    return Launch(store=Store(tmp_path), environment={}, report=events.append)


@pytest.mark.parametrize('refused', [False, True])
def test_launch_folder_stays_as_long_as_the_interface(
        launch: Launch, monkeypatch: pytest.MonkeyPatch, refused: bool) -> None:
    down = Command(('false' if refused else 'true',), what='take it down')
    monkeypatch.setattr(FakeVpn, 'down', lambda self, interface: iter([down]))
    launch.robot_vpn().ensure()
    folder = launch.store.launch_folder(launch.id)
    assert len(launch.down()) == refused
    assert folder.exists() == refused
    # what gc sees when this process has gone
    monkeypatch.setattr(endings, 'launch_process', lambda folder: (1, False))
    assert [found.name for found in endings.leftovers(launch.store)] == [launch.id] * refused


def test_it_is_said_once_each_time(
        launch: Launch, monkeypatch: pytest.MonkeyPatch, events: list[Event]) -> None:
    robot = launch.robot_vpn()
    for granted in (True, False, False, True, False):
        monkeypatch.setattr(process, 'sudo_trouble',
                            lambda granted=granted: None if granted else process.PASSWORD)
        robot._refresh_ticket()
    assert [event.fatal for event in events if isinstance(event, StepFailed)] == [False, False]
