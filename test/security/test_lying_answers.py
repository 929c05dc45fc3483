# SPDX-License-Identifier: Apache-2.0
"""Odd output of a command on a hijacked machine is one clear error of the launch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fogros2.dds.cyclonedds import CycloneDds
from fogros2.errors import FogError
from fogros2.host import inspection, installer, modules, wheels
from fogros2.model import NodeSpec, Result, SyncReport
from fogros2.shell import host_key, sync
from fogros2.untrusted import InvalidMessage
from fogros2.vpn import addresses
from fogros2_features.containers.engine import Engine
from fogros2_features.replacement import snapshots
from fogros2_monitor import access
from fogros2_testing import FakeRunning, FakeShell

DIGITS = '9' * 5000
#: What a machine may print in place of what was asked for.
ANSWERS = [
    '', '\n', ' ', '0', '-', '²', '٣', DIGITS, 'x', 'x x', '\x1b[2J', '\0', 'unreadable',
    '[' * 200_000, '[[3, 11], "x86_64", "glibc ²", {"nonsense": ""}]', '[[3], 1, 2, 3]', '[[]]',
    '[[3, Infinity], "x86_64", "glibc 2", {}]', '[[3, 11], "x86_64", "glibc 2", []]',
    '[{"addr_info": 7}]', '[{"addr_info": [{"local": "x", "prefixlen": {}}]}]', '[{"dst": []}]',
    '[7]', '{"a": 1}', 'null', f'[{DIGITS}]', f'user {DIGITS} x', 'user ² x', 'python x y 1 /p',
    'home :module', 'home', 'libc glibc ²', f'libc glibc {DIGITS}.1', 'route blackhole', 'disk ²',
    'route 1.2.3.4/99', '-----BEGIN CERTIFICATE-----\nx\n-----END CERTIFICATE-----',
    f'Total bytes sent: {DIGITS}', f'{DIGITS} {DIGITS}%', 'ssh-ed25519 AA x', '#apt\n-x']


class Machine(FakeShell):
    """A machine whose commands all print the same."""

    def __init__(self, answer: str) -> None:
        handlers = {name: lambda _: Result(0, answer, '') for name in ('sh', 'cat')}
        super().__init__(handlers=handlers)


def facts(answer: str, _: Path) -> None:
    found = inspection.parse_facts(answer)
    addresses.overlapping('198.18.7.0/24', found.routes)
    wheels.runs_on('glibc 2.36', found.libc)
    assert not sync.place(f'{found.home}/ws', remote=True).startswith('machine::')


def checkpoints(answer: str, folder: Path) -> None:
    snapshots.Checkpoint('~/map', folder).save(Machine(answer), still=True)


def images(answer: str, _: Path) -> None:
    Engine().inside(FakeRunning(Machine(answer)), [
        NodeSpec('1', 'n', 'p', 'e', features={'containers': {'image': 'image'}})])


def installed(answer: str, _: Path) -> None:
    found = modules.answer(answer)
    modules.copy(found)
    wheels.runs_on('glibc 2.36', found.libc)


def tokens(answer: str, _: Path) -> None:
    record = SimpleNamespace(agent='/run/a', launch_alive=True, launch='1', notes={
        'monitor': 'ws://198.18.7.2:1', 'monitor_open': '203.0.113.1:8765'})
    entry: Any = SimpleNamespace(name='planner', provider='fake', record=record)
    for read in (lambda: access.token_of(entry, Machine(answer), 1),
                 lambda: access.credentials_of(entry, Machine(answer))[1]):
        assert read().isascii()


def transfers(answer: str, _: Path) -> None:
    assert isinstance(sync.report(answer, 1.0), SyncReport)
    sync.Progress(lambda *_: None)(answer)
    error = sync.explained(Result(1, answer, answer), Path('/ws'), "'planner'")
    assert isinstance(error, FogError)


READERS: dict[str, Callable[[str, Path], object]] = {
    'facts': facts, 'checkpoints': checkpoints, 'images': images, 'modules': installed,
    'tokens': tokens, 'rsync': transfers,
    'networks': lambda answer, _: addresses.parse_used(answer),
    'host key': lambda answer, _: host_key.parse(answer),
    'interfaces': lambda answer, _: CycloneDds(domain=0).parse_lan(answer),
    'packages': lambda answer, _: installer.resolved(answer)}


@pytest.mark.parametrize('name', READERS)
def test_odd_answer_of_a_command_is_read_or_refused(name: str, tmp_path: Path) -> None:
    for number, answer in enumerate(ANSWERS):
        try:
            READERS[name](answer, tmp_path / str(number))
        except (FogError, InvalidMessage) as error:
            assert str(error), answer[:100]
