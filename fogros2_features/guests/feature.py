# SPDX-License-Identifier: Apache-2.0
"""What ``ros2 fog status`` shows of a machine's guests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from fogros2.feature import Feature
from fogros2.shell import Shell
from fogros2.store import Record


class Guests(Feature):
    """The computers that were invited to a machine; no keyword is needed."""

    headings: ClassVar[Sequence[str]] = ('GUEST', 'ADDRESS', 'HEARD', 'MAY JOIN', 'KEY')

    def entries(self, record: Record, shell: Shell) -> Sequence[Mapping[str, Any]]:
        """Ask the machine for its guests."""
        from fogros2_features.guests import listing
        return listing.ask(shell, record, 'look')

    def row(self, entry: Mapping[str, Any]) -> Sequence[str]:
        """Return a guest for people."""
        from ros2fog_cli.api.table import duration
        return (
            entry['label'] or '-', entry['address'],
            'never' if entry['heard'] is None else f"{duration(entry['heard'])} ago",
            f"{duration(entry['left'])} more" if entry['left'] > 0 else 'no more', entry['key'])
