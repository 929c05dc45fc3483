# SPDX-License-Identifier: Apache-2.0
"""Machines of launches of commit 326363e: its folders, tags and journals are still read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import json
from pathlib import Path
import shutil
import time
from typing import Any

from launch import LaunchContext
import pytest
from ros2cli.cli import main

from fogros2 import (
    AWSCloudInstance,
    ContainerInstance,
    journal,
    KubeInstance,
    process,
    SSHInstance,
)
from fogros2 import shell as shells
from fogros2.errors import Unsupported
from fogros2.model import Command, Machine, MachineState, Result, to_json
from fogros2.provider import Capabilities
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.container import machine as container_machine
from fogros2.provider.kubernetes.names import MachineId as JobId
from fogros2.provider.ssh import SSHProvider
from fogros2.report import silent
from fogros2.store import Store
from fogros2.testing.fakes import FakeProvider, FakeShell
from fogros2.testing.plugins import instead
from ros2fog_cli.api import endings, machines, reach
from ros2fog_cli.api.machines import Entry

RECORDS = Path(__file__).with_name('records_326363e')
PROVIDERS = sorted(path.name for path in RECORDS.iterdir())
ROBOT = 'robot-1000'
#: A minute after the machines were created.
NOW = 1795000060.0
LAUNCH = '0a1b2d'


class Recorded(FakeProvider):
    """A provider with the recorded machines, which all run."""

    capabilities = Capabilities()
    machines: dict[str, Machine] = {}

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        if self.name == 'ssh':
            raise Unsupported('no tags')
        return super().find(tags)


@pytest.fixture(params=PROVIDERS)
def provider(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> str:
    name: str = request.param
    shutil.copytree(RECORDS / name, tmp_path / 'state')
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path / 'state'))
    monkeypatch.setattr(machines, 'robot_name', lambda: ROBOT)
    monkeypatch.setattr(time, 'time', lambda: NOW)
    Recorded.machines = {}
    monkeypatch.setattr(Recorded, 'name', name, raising=False)
    for path in (tmp_path / 'state/machines').iterdir():
        told = json.loads((path / 'tags.json').read_text())
        Recorded.machines[told['id']] = Machine(
            told['id'], path.name, name, MachineState.RUNNING, tags=told['tags'],
            owned=name != 'ssh')
    instead(monkeypatch, 'fogros2.provider', {name: Recorded})
    return name


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[Command]:
    """Return the commands that would run on the robot."""
    ran: list[Command] = []

    def run(command: Command, **_: Any) -> Result:
        ran.append(command)
        return Result(0, '', '')

    monkeypatch.setattr(process, 'run', run)
    monkeypatch.setattr(shells, 'connect', lambda *_, **__: FakeShell(handlers={
        'sh': lambda command: Result(0, '', ''), 'rm': lambda command: Result(0, '', ''),
        'test': lambda command: Result(1, '', '')}))
    return ran


def entries() -> dict[str, Entry]:
    warned: list[str] = []
    found = {entry.name: entry for entry in machines.survey(warned.append)}
    assert warned == []
    return found


def test_machines_are_listed(provider: str) -> None:
    assert {name: entry.state for name, entry in entries().items()} == {
        f'{provider}-kept': 'running', f'{provider}-killed': 'running (launch gone)'}
    assert all(entry.own and entry.expires == NOW - 55 + 8 * 3600 for entry in entries().values())


def test_kept_machine_is_connected_to(provider: str) -> None:
    name = f'{provider}-kept'
    found = reach.endpoint(reach.find(name, print))
    assert (found.kind, found.key_file) == {
        'kubernetes': ('kubernetes', None), 'ssh': ('ssh', None)}.get(
            provider, ('ssh', f'/home/fog/.local/state/fogros2/machines/{name}/id_ed25519'))
    record = Store().load(name)
    assert record.agent_program == f'/run/fogros2/{name}/agent.py' and record.vpn is not None


def test_kept_machine_is_deleted(provider: str, commands: list[Command]) -> None:
    name = f'{provider}-kept'
    endings.delete(entries()[name], Store(), silent)
    assert [*entries()] == [f'{provider}-killed']


def test_gc_collects_machine_of_killed_launch(provider: str, commands: list[Command]) -> None:
    assert main(argv=['fog', 'gc']) == 0
    assert [*entries()] == [f'{provider}-kept']
    assert not (Store().root / 'launches' / LAUNCH).exists()
    assert any(f'fog{LAUNCH}' in ' '.join(command.argv) for command in commands)


def test_ids_are_those_of_the_providers() -> None:
    ids = {provider: json.loads((
        RECORDS / provider / 'machines' / f'{provider}-kept/tags.json').read_text())['id']
        for provider in PROVIDERS}
    assert AWSProvider()._id(ids['aws']).vm == 'i-0123456789abcdef0'
    assert container_machine.parse_id(ids['container'])[1] == '0123456789ab'
    assert JobId.parse(ids['kubernetes']).namespace == 'robots'
    assert not SSHProvider().describe(ids['ssh'].replace('198.51.100.30', '127.0.0.1')).owned


@pytest.mark.parametrize('instance', [
    AWSCloudInstance(name='aws', region='us-west-1', ec2_instance_type='t3.large', disk_size=20),
    ContainerInstance(name='container', memory='2g'),
    KubeInstance(name='kubernetes', mcpu=2000, namespace='robots'),
    SSHInstance(name='ssh', host='198.51.100.30', user='fog', port=22)], ids=PROVIDERS)
def test_same_launch_file_takes_kept_machine(instance: Any) -> None:
    """It asks for the options that the record has."""
    spec = instance.spec(LaunchContext())
    record = Store(RECORDS / spec.name).load(f'{spec.name}-kept')
    assert json.loads(to_json(spec.options)) == record.asked_options


def test_journal_is_read(provider: str) -> None:
    lines = (Store().root / 'launches' / LAUNCH / journal.FILE).read_text().splitlines()
    assert [(step.step, step.state, step.done) for step in journal.steps(lines)] == [
        ('machine', 'done', 0), ('workspace', 'running', 10)]
