# SPDX-License-Identifier: Apache-2.0
"""Describe an agent's events in words."""

from __future__ import annotations

from typing import Optional

from fogros2.events import Event

#: The text of each event that is for users.
_TEXTS = {
    'output': '{text}',
    'started': 'process started with pid [{pid}]',
    'exited': 'process has finished with exit code {returncode}',
    'refused': 'could not be started: {error}',
    'watchdog': 'watchdog: {reason}, {action}',
    'notice': 'the provider takes the machine away: {reason}',
    'gap': '{count} older events are not kept any more',
}


def describe(event: Event) -> Optional[str]:
    """Return an event as text, None for an event that is not for users."""
    text = _TEXTS.get(event['event'])
    return None if text is None else text.format_map(event)
