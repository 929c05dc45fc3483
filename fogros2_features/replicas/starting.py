# SPDX-License-Identifier: Apache-2.0
"""Check a group of replicas, start its node ``first_answer`` and tell it of ended processes."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
import contextlib
import functools
import json
import math
import os
from pathlib import Path
from typing import Any, Optional

from launch import Event, EventHandler, LaunchContext
from launch.actions import OpaqueFunction
from launch.events.process import ProcessExited, ProcessStarted

from fogros2 import ros_names as names
from fogros2.describe.keywords import ROBOT
from fogros2.errors import ConfigurationError
from fogros2.launch_internals import private
from fogros2.model import NodeSpec
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.interruption import MachineInterrupted
from fogros2.runtime.remote_process import remote_of
from fogros2.runtime.session import Session


def check(
    machines: Sequence[str], services: Sequence[str], topics: Sequence[tuple[str, str]],
    hedge_after: Any, deadline: Any = None,
) -> None:
    """
    Check what a launch file declares; all names are resolved.

    :raises ConfigurationError: too few machines, a name that is invalid or repeated, a ROS action.
    """
    if len(machines) < 2:
        raise ConfigurationError(
            f'replicas need two machines or more, not {len(machines)}',
            'add machines, or use CloudGroup for one')
    outputs = [output for _, output in topics]
    for kind, values in (('machine', machines), ('name', [*services, *outputs])):
        for name in values:
            if values.count(name) > 1:
                raise ConfigurationError(
                    f"replicas have the {kind} '{name}' twice", 'name each once')
    if not services and not topics:
        raise ConfigurationError(
            'replicas need a service or a pair of topics that the first answer serves',
            "such as services=['/plan'] or topics=[('/image', '/detections')]")
    for name in [*services, *(name for pair in topics for name in pair)]:
        if '/_action/' in name:
            raise ConfigurationError(
                f"'{name}' belongs to a ROS action, whose goals, feedback and results are those "
                'of one replica', 'run the nodes of an action on one machine')
        if not names.TOPIC.fullmatch(name) or '__' in name:
            raise ConfigurationError(f"'{name}' is not the full name of a topic or a service",
                                     "such as '/plan' or '/camera/image_raw'")
    if (ROBOT in machines) != (deadline is not None) or deadline is not None and not (
            isinstance(deadline, (int, float)) and 0 < deadline < math.inf):
        raise ConfigurationError(
            f'deadline={deadline!r}: the robot answers last, after so many seconds',
            'write machines=[..., None], deadline=0.2, or leave both out')
    if hedge_after is not None and hedge_after != 'p95' and not (
            isinstance(hedge_after, (int, float)) and hedge_after > 0):
        raise ConfigurationError(f'hedge_after={hedge_after!r} is no time',
                                 "give milliseconds, such as 50, or 'p95'")


def first_answer(
    folder: Path, sessions: Mapping[str, Session], services: Sequence[str],
    topics: Sequence[tuple[str, str, bool]], hedge_after: Any, deadline: Optional[float],
    context: LaunchContext,
) -> AddedProcess:
    """
    Return the process that serves the public names, from when the first machine is up.

    :param folder: the launch's folder, for figures of the replicas.
    :param topics: input, output, and whether a feature brings the input to the machines.
    :param deadline: seconds after which the robot's own replica is asked, None without it.
    """
    label = f'first_answer_{names.identifier([*services, *(pair[1] for pair in topics)][0])}'
    events = folder / f'{label}.events'
    os.mkfifo(events, 0o600)
    process = AddedProcess(NodeSpec(
        id=f'robot/{label}', name=label, package='fogros2', executable='first_answer',
        respawn=True, respawn_delay=1.0, arguments=(json.dumps({
            'name': label, 'services': services, 'topics': topics, 'hedge_after': hedge_after,
            'replicas': {name: names.local_topic('', name) for name in (
                *sessions, *[ROBOT] * (deadline is not None))},
            **({} if deadline is None else {'last': ROBOT, 'deadline': deadline}),
            'folder': str(folder)}),)))
    private.delay_start(process, functools.partial(_first_up, list(sessions.values())))

    def matches(event: Event) -> bool:
        return bool(_news(event, sessions))

    context.register_event_handler(EventHandler(matcher=matches, entities=OpaqueFunction(
        function=lambda context: _tell(events, _news(context.locals.event, sessions)))))
    return process


async def _first_up(sessions: Sequence[Session]) -> bool:
    waits = [asyncio.shield(session.came_up) for session in sessions]
    await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    return any(wait.done() and wait.result() for wait in waits)


def _news(event: Event, sessions: Mapping[str, Session]) -> str:
    """Return a line for ``first_answer`` about a replica's process, '' for other events."""
    if isinstance(event, MachineInterrupted):
        return f'died {event.machine}' if event.machine in sessions else ''
    if not isinstance(event, (ProcessExited, ProcessStarted)):
        return ''
    action = event.action
    remote = remote_of(action)
    if remote is None or isinstance(action, AddedProcess):
        return ''
    what = 'died' if isinstance(event, ProcessExited) else 'started'
    return next((f'{what} {name}' for name, session in sessions.items()
                 if session is remote.session), '')


def _tell(path: Path, line: str) -> None:
    # without a reader, as before its start, first_answer learns by itself
    with contextlib.suppress(OSError):
        pipe = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        try:
            os.write(pipe, f'{line}\n'.encode())
        finally:
            os.close(pipe)
