# SPDX-License-Identifier: Apache-2.0
"""A hijacked machine's texts move no cursor and set no clipboard on the user's terminal."""

from __future__ import annotations

import json
import queue
import re
from typing import Any

import pytest

from fogros2.agent_client import AgentClient
from fogros2.errors import CommandError
from fogros2.model import Command, Result
from fogros2.shell import command_line, lines
from fogros2.waiting import wait_until
from ros2fog_cli.verb import logs

#: Writes the clipboard, sets the title, clears the screen, types an answer, moves up, hides text
#: by its direction; in 8-bit form; overwrites the line; a lone surrogate.
ATTACKS = ['\x1b]52;c;cm0gLXJm\x07', '\x1b]0;title\x1b\\', '\x1b[2J\x1b[H', '\x1b[6n', '\x1bc',
           '\x1b[1A', '\x1bP+q\x1b\\', '\x9b2J', '\x9d0;title\x9c', '\b\b\b', '\x0e', '\u202e',
           '\rroot@robot:~# ', '\ud800']
RED = '\x1b[1;31mred\x1b[0m'
ALLOWED = re.compile('\x1b\\[[0-9;]*m')


class Machine:
    """An agent that answers requests, and sends events when the log is followed."""

    def __init__(self, sent: list[dict[str, Any]]) -> None:
        self.sent, self.lines = sent, queue.Queue[bytes]()

    def open(self, command: object) -> Machine:
        return self

    def write(self, data: bytes) -> None:
        for line in data.splitlines():
            request = json.loads(line)
            if request['command'] != 'log':
                continue
            answer = {'id': request['id'], 'ok': True, 'first': 1, 'next': 1, 'lost': 0}
            for message in (answer, *self.sent):
                self.lines.put(json.dumps(message).encode() + b'\n')

    def readline(self) -> bytes:
        return self.lines.get()

    def close(self) -> None:
        self.lines.put(b'')


def received(sent: list[dict[str, Any]]) -> list[Any]:
    """Return the events as the robot's programs get them."""
    found: list[Any] = []
    shell: Any = Machine(sent)
    client = AgentClient(shell, '/run/x', agent_path='/run/x/agent.py')
    try:
        client.subscribe(found.append, since=1)
        wait_until(lambda: len(found) == len(sent) or None, timeout=10, what='the events')
    finally:
        client.close()
    return found


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
        {'event': 'launch_exited', 'returncode': 1, 'said': attack, 'seq': 5}])
    for event in found:
        logs.show(event, None)
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
    logs.show(event, None)
    assert capsys.readouterr().out == '[talker] 10 %\n[talker] 20 %\n'


@pytest.mark.parametrize('attack', ATTACKS[:-1])
def test_no_output_of_a_command_controls_the_terminal(attack: str) -> None:
    said: list[str] = []
    output = lines.Output(said.append)
    output.add(f'{attack}\nend{attack}'.encode(), attack.encode())
    out, err = output.text()
    assert harmless(err) and all(map(harmless, said)), ascii(err)
    assert out == f'{attack}\nend{attack}', 'programs read it'
    for result in (Result(1, out, ''), Result(1, '', err)):
        with pytest.raises(CommandError) as failed:
            command_line.checked(Command(('x',)), result, "'planner'")
        assert harmless(str(failed.value)), ascii(str(failed.value))
