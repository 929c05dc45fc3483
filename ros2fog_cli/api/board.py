# SPDX-License-Identifier: Apache-2.0
"""What the dashboard shows: the live state, and the graphs of the launches that run."""

from __future__ import annotations

import dataclasses
from typing import Any, Optional

from fogros2.store import Store
from ros2fog_cli.api.graphs import Graphs
from ros2fog_cli.api.live import Live


class Board:
    """
    The dashboard's source; see :class:`fogros2_monitor.dashboard.server.Source`.

    :param topics: whether to join launches, for rates of topics and pictures.
    """

    def __init__(
        self, store: Optional[Store] = None, *, regions: Optional[list[str]] = None,
        topics: bool = True,
    ) -> None:
        store = store or Store()
        self._graphs = Graphs(store) if topics else None
        self._live = Live(store, regions=regions, more=self._look_at_graphs)

    def start(self) -> None:
        """Begin to look."""
        self._live.start()

    def close(self) -> None:
        """End all that was begun."""
        self._live.close()
        if self._graphs is not None:
            self._graphs.close()

    def state(self, after: int, timeout: float) -> dict[str, Any]:
        """Return the state once it is a later one."""
        return self._live.state(after, timeout)

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        """Return a machine's newer log lines."""
        return [dataclasses.asdict(line) for line in self._live.lines(machine, after)]

    def picture(self, stream: str) -> Optional[bytes]:
        """Return the last picture of a stream."""
        return self._graphs.picture(stream) if self._graphs is not None else None

    def delete(self, machine: str, force: bool) -> None:
        """Begin to end a machine."""
        self._live.delete(machine, force=force)

    def _look_at_graphs(self, live: Live) -> dict[str, Any]:
        return {} if self._graphs is None else self._graphs.look(live)
