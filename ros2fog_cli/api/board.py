# SPDX-License-Identifier: Apache-2.0
"""The data of the dashboard: the live state of machines, and the graphs of running launches."""

from __future__ import annotations

import dataclasses
from typing import Any, Optional

from fogros2.store import Store
from ros2fog_cli.api.graphs import Graphs
from ros2fog_cli.api.live import Live


class Board:
    """
    The dashboard's source of data; see :class:`fogros2_monitor.dashboard.server.Source`.

    :param topics: whether to join launches, to measure topic rates and take pictures.
    """

    def __init__(
        self, store: Optional[Store] = None, *, regions: Optional[list[str]] = None,
        topics: bool = True,
    ) -> None:
        store = store or Store()
        self._graphs = Graphs(store) if topics else None
        self._live = Live(store, regions=regions, more=self._look_at_graphs)

    def start(self) -> None:
        """Start to collect data."""
        self._live.start()

    def close(self) -> None:
        """Stop all threads and programs that this object started."""
        self._live.close()
        if self._graphs is not None:
            self._graphs.close()

    def state(self, after: int, timeout: float) -> dict[str, Any]:
        """Return the state; wait up to ``timeout`` seconds for one newer than ``after``."""
        return self._live.state(after, timeout)

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        """Return the lines of a machine's log that follow line number ``after``."""
        return [dataclasses.asdict(line) for line in self._live.lines(machine, after)]

    def picture(self, stream: str) -> Optional[bytes]:
        """Return the last picture of a stream."""
        return self._graphs.picture(stream) if self._graphs is not None else None

    def delete(self, machine: str, force: bool) -> None:
        """Start to delete a machine."""
        self._live.delete(machine, force=force)

    def _look_at_graphs(self, live: Live) -> dict[str, Any]:
        return {} if self._graphs is None else self._graphs.look(live)
