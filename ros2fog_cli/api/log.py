# SPDX-License-Identifier: Apache-2.0
"""Describe an agent's events in words."""

from __future__ import annotations

from typing import Any, Optional


def describe(event: dict[str, Any]) -> Optional[str]:
    """Return an event as text, None for an event that is not for users."""
    kind = event.get('event')
    if kind == 'output':
        return str(event.get('text', ''))
    if kind == 'started':
        return f"process started with pid [{event.get('pid')}]"
    if kind == 'exited':
        return f"process has finished with exit code {event.get('returncode')}"
    if kind == 'refused':
        return f"could not be started: {event.get('error')}"
    if kind == 'watchdog':
        return f"watchdog: {event.get('reason')}, {event.get('action')}"
    if kind == 'notice':
        return f"the provider takes the machine away: {event.get('reason')}"
    if kind == 'gap':
        return f"{event.get('count')} older events are not kept any more"
    return None
