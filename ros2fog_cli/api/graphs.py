# SPDX-License-Identifier: Apache-2.0
"""Start a program for each launch on the dashboard; it measures topic rates and takes pictures."""

from __future__ import annotations

import base64
from collections import deque
from collections.abc import Sequence
import contextlib
import json
import os
import subprocess
import threading
import time
from typing import Any, Optional

from fogros2 import plugin_system
from fogros2.errors import FogError
from fogros2.store import Record, Store
from ros2fog_cli.api import reach

#: Seconds before an ended program is restarted, and time-out of a program's end in seconds.
AGAIN, TIMEOUT = 10.0, 5.0


class Graph:
    """
    A program that observes the ROS graph of one launch.

    :param environment: the environment variables of the program.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self.streams: list[dict[str, Any]] = []
        self.topics: list[dict[str, Any]] = []
        self.pictures: dict[str, tuple[int, bytes]] = {}
        self._notes: dict[str, str] = {}
        self._said: deque[str] = deque(maxlen=5)
        self._told = ''
        # A launch has its own DDS configuration, so its graph needs its own process.
        self._process = subprocess.Popen(
            plugin_system.load('fogros2.monitor', 'graph'), stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors='replace',
            env=environment,
            # Ctrl-C must reach only this process, which then closes the program's standard input.
            start_new_session=True)
        self._readers = [threading.Thread(target=read, daemon=True, name='fog-graph')
                         for read in (self._read, self._read_errors)]
        for reader in self._readers:
            reader.start()

    @property
    def alive(self) -> bool:
        """Whether the program runs."""
        return self._process.poll() is None

    @property
    def trouble(self) -> str:
        """The last line of the program's standard error, or its exit status."""
        return self._said[-1] if self._said else f'exit status {self._process.returncode}'

    def know(self, machines: dict[str, Sequence[str]], *, pictures: bool) -> None:
        """Send the program the nodes of each machine, and whether to take pictures."""
        line = json.dumps({'machines': machines, 'pictures': pictures})
        if line != self._told and self._process.stdin is not None:
            self._told = line
            with contextlib.suppress(OSError, ValueError):
                self._process.stdin.write(line + '\n')
                self._process.stdin.flush()

    def close(self) -> None:
        """Stop the program."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            self._process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for reader in self._readers:
            reader.join(2.0)
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()

    def state(self) -> list[dict[str, Any]]:
        """Return the streams, each with the number of its last picture."""
        return [{**one, 'picture': self.pictures.get(one['topic'], (0, b''))[0],
                 'note': one['note'] or self._notes.get(one['topic'], '')}
                for one in self.streams]

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError, KeyError, TypeError):
                message = json.loads(line)
                if not isinstance(message, dict):
                    continue  # a library printed this line
                if 'streams' in message:
                    self.streams, self.topics = message['streams'], message['topics']
                elif 'data' in message:
                    self.pictures[message['picture']] = (
                        int(message['number']), base64.b64decode(message['data']))
                else:
                    self._notes[message['picture']] = str(message['note'])

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._said.append(line.strip()[:300])


class Graphs:
    """
    The graph programs of all running launches.

    :param pictures: whether the programs take pictures.
    """

    def __init__(self, store: Store, *, pictures: bool) -> None:
        self._store, self._pictures = store, pictures
        self._graphs: dict[str, Graph] = {}
        self._refused: dict[str, tuple[float, str]] = {}

    def update(self, machines: Sequence[tuple[Record, Sequence[str]]]) -> dict[str, Any]:
        """
        Run one program for each launch of these machines, and return the collected data.

        :param machines: records of machines that are up, each with the names of its nodes.
        """
        launches = {record.launch: record for record, _ in machines}
        for launch in [launch for launch in self._graphs if launch not in launches]:
            self._graphs.pop(launch).close()
        for launch, one in launches.items():
            graph = self._graph(launch, one)
            if graph is not None:
                # streams are named after the launch's other machines too
                known: dict[str, Sequence[str]] = {
                    record.name: () for record in self._store.machines()
                    if record.launch == launch}
                known.update((record.name, nodes) for record, nodes in machines
                             if record.launch == launch)
                graph.know(known, pictures=self._pictures)
        trouble = [why for launch, (_, why) in self._refused.items()
                   if launch in launches and launch not in self._graphs]
        return {
            'streams': [{**one, 'id': f"{launch} {one['topic']}"}
                        for launch, graph in sorted(self._graphs.items())
                        for one in graph.state()],
            'topics': [one for _, graph in sorted(self._graphs.items()) for one in graph.topics],
            'graph_trouble': trouble}

    def picture(self, name: str) -> Optional[bytes]:
        """Return the last picture of a stream, by the stream's id."""
        launch, _, topic = name.partition(' ')
        graph = self._graphs.get(launch)
        return graph.pictures.get(topic, (0, None))[1] if graph is not None else None

    def close(self) -> None:
        """Stop all programs."""
        while self._graphs:
            self._graphs.popitem()[1].close()

    def _graph(self, launch: str, record: Record) -> Optional[Graph]:
        graph = self._graphs.get(launch)
        if graph is not None and graph.alive:
            return graph
        now = time.monotonic()
        if graph is not None:
            del self._graphs[launch]
            graph.close()
            self._refused[launch] = now, f'topics are not looked at: {graph.trouble}'
        if now - self._refused.get(launch, (-1e9, ''))[0] < AGAIN:
            return None
        try:
            environment = reach.robot_environment(record, self._store)
            if environment is None:
                return None  # the launch has just ended
            self._graphs[launch] = Graph({**os.environ, **environment})
        except FogError as error:
            self._refused[launch] = now, f'topics are not looked at: {error}'
            return None
        return self._graphs[launch]
