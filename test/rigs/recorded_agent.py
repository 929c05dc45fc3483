# SPDX-License-Identifier: Apache-2.0
"""What an agent wrote and answered, recorded from a run of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

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
