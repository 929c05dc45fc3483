# SPDX-License-Identifier: Apache-2.0
"""A hijacked machine's texts move no cursor and set no clipboard on the user's terminal."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
import io
import logging
from pathlib import Path
import re
import sys
from typing import Any

import pytest

from fogros2 import report
from fogros2.agent_client import AgentClient
from fogros2.errors import CommandError, FogError, ShellError
from fogros2.model import Command, Result
from fogros2.shell import command_line, sync
from fogros2.waiting import wait_until
from fogros2_features.replacement.snapshots import Checkpoint
from fogros2_testing import FakeShell
from rigs.recorded_agent import ScriptedShell, ScriptedStream
from ros2fog_cli.api import output, progress, table
from ros2fog_cli.api.log import Lines
from ros2fog_cli.command.fog import FogCommand
from ros2fog_cli.verb import logs, VerbExtension, warn

#: Writes the clipboard, sets the title, clears the screen, types an answer, moves up, hides text
#: by its direction; in 8-bit form; overwrites the line; a lone surrogate.
ATTACKS = ['\x1b]52;c;cm0gLXJm\x07', '\x1b]0;title\x1b\\', '\x1b[2J\x1b[H', '\x1b[6n', '\x1bc',
           '\x1b[1A', '\x1bP+q\x1b\\', '\x9b2J', '\x9d0;title\x9c', '\b\b\b', '\x0e', '\u202e',
           '\rroot@robot:~# ', '\ud800']
RED = '\x1b[1;31mred\x1b[0m'
ALLOWED = re.compile('\x1b\\[[0-9;]*m')


def received(sent: list[dict[str, Any]]) -> list[Any]:
    """Return the events as the robot's programs get them."""
    events: list[Any] = []
    shell: Any = ScriptedShell(ScriptedStream(lambda request: [
        {'id': request['id'], 'ok': True, 'first': 1, 'next': 1, 'lost': 0}, *sent]))
    client = AgentClient(shell, '/run/x', agent_path='/run/x/agent.py')
    try:
        client.subscribe(events.append, since=1)
        wait_until(lambda: len(events) == len(sent) or None, timeout=60, what='the events')
    finally:
        client.close()
    return events


def harmless(text: str) -> bool:
    return all(c.isprintable() or c in '\t\n' for c in ALLOWED.sub('', text))


@pytest.mark.parametrize('attack', ATTACKS)
def test_no_text_of_an_event_controls_the_terminal(
    attack: str, capsys: pytest.CaptureFixture[str],
) -> None:
    node = {'node': '1', 'name': f'talker{attack}'}
    found = received([
        {**node, 'event': 'output', 'stream': 'stdout', 'text': f'a{attack}b\t{RED}\n', 'seq': 1},
        {**node, 'event': 'refused', 'error': attack, 'hint': attack, 'seq': 2},
        {**node, 'event': 'started', 'pid': 1, 'cmd': ['x', attack], 'seq': 3},
        {'event': 'watchdog', 'reason': attack, 'action': attack, 'seq': 4},
        {'event': 'ending', 'reason': attack, 'seq': 5}])
    lines = Lines()
    for event in found:
        logs.show(str(event.get('name', '')), str(event.get('stream', '')), lines.of(event), None)
    out, err = capsys.readouterr()
    assert harmless(out + err), ascii(out + err)
    # what launch logs, and hands to handlers of the process's output
    for event in found:
        for text in (*map(str, event.values()), *event.get('cmd', [])):
            assert harmless(text) and text.encode(), ascii(text)
    assert RED in out and '\t' in out


def test_a_machine_cannot_overwrite_the_name_of_its_node(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (event,) = received([{'event': 'output', 'node': '1', 'name': 'talker', 'stream': 'stdout',
                          'text': '10 %\r20 %\r\n', 'seq': 1}])
    logs.show(event['name'], event['stream'], Lines().of(event), None)
    assert capsys.readouterr().out == '[talker] 10 %\n[talker] 20 %\n'


@pytest.mark.parametrize('attack', ATTACKS)
def test_no_error_controls_the_terminal(attack: str, tmp_path: Path) -> None:
    result = Result(1, f'out{attack}', '')
    unreadable = FakeShell(handlers={'sh': lambda _: Result(0, f'unreadable ./a{attack}', '')})
    with pytest.raises(ShellError) as lied:
        Checkpoint('~/map', tmp_path).save(unreadable, still=True)
    with pytest.raises(CommandError) as failed:
        command_line.checked(Command(('x',)), result, f"'{attack}'")
    for error in (lied.value, failed.value, FogError(attack, attack),
                  CommandError(Command(('x',)), dataclasses.replace(result, stderr=attack), 'm'),
                  sync.explained(Result(23, '', f'rsync: {attack}'), Path('/ws'), "'planner'"),
                  sync.explained(Result(23, '', f'noise {attack}'), Path('/ws'), "'planner'")):
        for text in (str(error), *map(str, error.args), error.hint):
            assert harmless(text), ascii(text)
    assert str(FogError(f'{RED}\ta\nb', 'c')) == f'{RED}\ta\nb (c)'


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[list[str]]:
    """Collect what launch's logger ``fogros2`` shows."""
    import launch.logging
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    texts: list[str] = []
    handler = logging.StreamHandler()
    handler.emit = lambda record: texts.append(record.getMessage())  # type: ignore
    logger = launch.logging.get_logger('fogros2')
    logger.addHandler(handler)
    yield texts
    logger.removeHandler(handler)
    launch.logging.reset()


@pytest.mark.parametrize('attack', ATTACKS)
def test_no_step_of_a_launch_controls_the_terminal(attack: str, logged: list[str]) -> None:
    import launch.logging

    from fogros2.runtime.console import Console
    console = Console(io.StringIO())
    console(report.StepDone('planner', 'ROS 2', 1.0, f'installed a{attack}'))
    console(report.StepFailed('planner', 'ROS 2', 1.0, attack, fatal=False))
    console(report.Warned('planner', f'may lack {attack}', attack))
    # other parts of a launch use this logger, too
    launch.logging.get_logger('fogros2').warning('%s: %s', attack, {'reason': attack})
    assert len(logged) == 4 and all(map(harmless, logged)), ascii(logged)


class Names(VerbExtension):
    """A verb that prints what other computers say."""

    def __init__(self, attack: str) -> None:
        super().__init__()
        self.attack = attack

    def main(self, *, args: argparse.Namespace) -> int:
        print(f'deleted {self.attack}', self.attack, RED)
        sys.stdout.write(self.attack)
        warn(self.attack)
        progress.report(report.StepFailed(self.attack, 'VPN', 1.0, self.attack))
        print(table.table(('NAME', 'IMAGE'), [(f'a{self.attack}\nb', self.attack), ('c', 'd')]))
        return 0


@pytest.mark.parametrize('attack', ATTACKS)
def test_no_verb_lets_a_name_control_the_terminal(
    attack: str, capsys: pytest.CaptureFixture[str],
) -> None:
    parser = argparse.ArgumentParser()
    assert FogCommand().main(
        parser=parser, args=argparse.Namespace(version=False, _verb=Names(attack))) == 0
    out, err = capsys.readouterr()
    assert harmless(out + err), ascii(out + err)
    assert RED in out and 'VPN failed' in err


def test_a_name_makes_no_row_of_its_own() -> None:
    text = table.table(('NAME', 'STATE'), [('a  running\nb', 'gone'), ('c', '\x1b[1mok')])
    assert text.splitlines() == ['NAME          STATE', 'a  running b  gone',
                                 'c             \N{REPLACEMENT CHARACTER}[1mok']


def test_progress_line_still_moves_the_cursor(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('TERM', 'xterm')
    monkeypatch.setattr('sys.stderr.isatty', lambda: True)
    monkeypatch.setattr(progress, 'TICK', 0.01)
    drawn: list[str] = []
    with output.cleaned(), progress.working('making\x1b[2J'):
        wait_until(lambda: drawn.append(capsys.readouterr().err) or any(drawn), timeout=60,
                   what='the line')
    assert ''.join(drawn).startswith('\r\x1b[Kmaking\N{REPLACEMENT CHARACTER}[2J 0 s')
