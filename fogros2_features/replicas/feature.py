# SPDX-License-Identifier: Apache-2.0
"""What ``ros2 fog status`` and the dashboard show of a machine's replicas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import json
from pathlib import Path
from typing import Any, ClassVar

from fogros2.feature import Feature


class Replicas(Feature):
    """The figures of replicas, which the nodes ``first_answer`` write; no keyword is needed."""

    headings: ClassVar[Sequence[str]] = (
        'REPLICA OF', 'STATE', 'SHARE', 'LATENCY', 'P95', 'FAILURES')

    def figures(self, folder: Path, machine: str) -> Sequence[Mapping[str, Any]]:
        """Return figures, one for each service or output that the machine replicates."""
        rows: list[Mapping[str, Any]] = []
        for path in sorted(folder.glob('first_answer_*.json')):
            with contextlib.suppress(OSError, ValueError):
                rows += [each for each in json.loads(path.read_text())
                         if each['machine'] == machine]
        return rows

    def row(self, entry: Mapping[str, Any]) -> Sequence[str]:
        """Return figures for people."""
        from ros2fog_cli.api.table import milliseconds, NONE
        share = NONE if entry['share'] is None else f"{entry['share']:.0%}"
        return (entry['of'], entry['state'], share, milliseconds(entry['latency']),
                milliseconds(entry['p95']), str(entry['failures']))
