# SPDX-License-Identifier: Apache-2.0
"""Describe an agent's events in lines of text."""

from __future__ import annotations

from fogros2.events import Event

#: The text of each event that is for users.
_TEXTS = {
    'output': '{text}',
    'started': 'process started with pid [{pid}]',
    'exited': 'process has finished with exit code {returncode}',
    'refused': 'could not be started: {error}',
    'watchdog': 'watchdog: {reason}, {action}',
    'notice': 'the provider takes the machine away: {reason}',
    'gap': '{count} events, such as output, are missing here',
}
#: Characters of output without a line's end that are kept for its rest.
_KEPT = 65_536


class Lines:
    """The lines of a log: a node's output comes in pieces, which may end within a line."""

    def __init__(self) -> None:
        #: The begin of a line, by name of the node and stream.
        self.begun: dict[tuple[str, str], str] = {}

    def of(self, event: Event) -> list[str]:
        """Return the lines that an event completes, none for an event that is not for users."""
        form = _TEXTS.get(event['event'])
        if form is None:
            return []
        text = form.format_map(event)
        if event['event'] == 'exited':
            last = [source for source in self.begun if source[0] == event['name']]
            return [*map(self.begun.pop, last), text]
        if event['event'] != 'output':
            return text.splitlines()
        source = event['name'], event['stream']
        # the last line is the one that has no end yet
        *lines, rest = f'{self.begun.pop(source, "")}{text}|'.splitlines()
        if len(rest) > _KEPT:
            return [*lines, rest[:-1]]
        if rest != '|':
            self.begun[source] = rest[:-1]
        return lines
