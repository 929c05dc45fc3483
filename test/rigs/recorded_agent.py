# SPDX-License-Identifier: Apache-2.0
"""What an agent wrote and answered, recorded from a run of it, and agents by a script."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import queue
from typing import Any

from fogros2.errors import ConnectError

Answer = Callable[[dict[str, Any]], list[Any]]
FOLDER = Path(__file__).with_name('agent_messages')


def events() -> list[dict[str, Any]]:
    """Return its events."""
    return [json.loads(line) for line in (FOLDER / 'events.jsonl').read_text().splitlines()]


def answers() -> list[tuple[str, dict[str, Any]]]:
    """Return its answers, each after the command."""
    found = map(json.loads, (FOLDER / 'answers.jsonl').read_text().splitlines())
    return [(one['command'], one['answer']) for one in found]


def answer(command: str, **changes: Any) -> dict[str, Any]:
    """Return an answer to a command, with changes."""
    return {**next(said for asked, said in answers() if asked == command), **changes}


class ScriptedStream:
    """An agent that answers with what a function returns; None in it ends the stream."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.lines: queue.Queue[bytes] = queue.Queue()
        self.asked: list[dict[str, Any]] = []
        self.received = b''

    def write(self, data: bytes) -> None:
        *lines, self.received = (self.received + data).split(b'\n')
        for line in lines:
            request = json.loads(line)
            self.asked.append(request)
            for message in self.answer(request):
                self.say(message)

    def say(self, message: Any) -> None:
        if message is None:
            self.lines.put(b'')
        elif isinstance(message, bytes):
            self.lines.put(message)
        else:
            self.lines.put(json.dumps(message).encode() + b'\n')

    def readline(self) -> bytes:
        return self.lines.get()

    def close(self) -> None:
        self.lines.put(b'')


class ScriptedShell:
    """Opens the streams it is given, one after the other; an exception is raised instead."""

    def __init__(self, *streams: Any) -> None:
        self.streams = list(streams)
        self.opened: list[Any] = []

    def open(self, command: Any) -> Any:
        self.command = command
        if not self.streams:
            raise ConnectError('no more')
        stream = self.streams.pop(0)
        if isinstance(stream, Exception):
            raise stream
        self.opened.append(stream)
        return stream
