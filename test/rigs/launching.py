# SPDX-License-Identifier: Apache-2.0
"""What the launches of ``test/launch`` have in common."""

from __future__ import annotations

import dataclasses
from typing import Any

from launch import EventHandler, LaunchContext
from launch.actions import OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit, OnProcessIO, OnProcessStart, OnShutdown

from fogros2 import MachineInterrupted
from fogros2.model import NodeSpec
from fogros2_features.streams.nodes import H264
from fogros2_features.streams.transport import Stream


class Harmless(H264):
    """H.264's decisions, carried out by the talker of package ``demo``."""

    def encoder(self, stream: Stream) -> NodeSpec:
        return dataclasses.replace(super().encoder(stream), package='demo', executable='talker')

    def decoder(self, stream: Stream) -> NodeSpec:
        return dataclasses.replace(super().decoder(stream), package='demo', executable='talker')


def ends(machine: Any, node: NodeSpec) -> None:
    """Have a node of a FakeMachine exit as soon as it started, so that the launch ends."""
    machine.say('exited', node, returncode=0, respawns=False)


#: A program that says where it runs, and ends when told to.
HERE = """#!/bin/sh
echo "here: $*"
exec sleep 60
"""


class Watch:
    """Notes what launch says of processes, and does something at the n-th start."""

    def __init__(self) -> None:
        #: The name and program of each process, and the name and status of each that has ended.
        self.starts: list[tuple[str, str]] = []
        self.exits: list[tuple[str, int]] = []
        self.said: list[str] = []
        self.interrupted: list[tuple[str, str, bool]] = []
        self.shutdowns: list[str] = []
        self.at_start: dict[int, Any] = {}

    def __call__(self) -> list[Any]:
        """Return the handlers of a launch description."""
        return [
            RegisterEventHandler(OnProcessStart(on_start=self._start)),
            RegisterEventHandler(OnProcessExit(on_exit=self._exit)),
            RegisterEventHandler(OnProcessIO(on_stdout=self._io)),
            RegisterEventHandler(OnShutdown(on_shutdown=self._shutdown)),
            RegisterEventHandler(EventHandler(
                matcher=lambda event: isinstance(event, MachineInterrupted),
                entities=[OpaqueFunction(function=self._interrupted)])),
        ]

    def _start(self, event: Any, context: LaunchContext) -> Any:
        self.starts.append((plain(event.process_name), event.cmd[0]))
        do = self.at_start.get(len(self.starts))
        return None if do is None else do(event)

    def _exit(self, event: Any, context: LaunchContext) -> None:
        self.exits.append((plain(event.process_name), event.returncode))

    def _io(self, event: Any) -> None:
        self.said.append(event.text.decode())

    def _shutdown(self, event: Any, context: LaunchContext) -> None:
        self.shutdowns.append(event.reason)

    def _interrupted(self, context: LaunchContext) -> None:
        event = context.locals.event
        self.interrupted.append((event.machine, event.reason, event.lost))


def plain(name: str) -> str:
    """Return the name of a process without launch's number."""
    return name.rpartition('-')[0]


def end(event: Any = None) -> list[Any]:
    """Return what ends a launch."""
    return [Shutdown(reason='the test is over')]


def says(fake: Any, kind: str, **fields: Any) -> Any:
    """Return what has the machine say something, once all there is to visit was visited."""
    def do(event: Any = None) -> list[Any]:
        return [OpaqueFunction(function=lambda context: context.asyncio_loop.call_soon(
            lambda: fake.machines['planner'].say(kind, **fields)) and None)]
    return do
