# SPDX-License-Identifier: Apache-2.0
"""Handle the preemption of a machine: emit an event, and move its nodes or end the launch."""

from __future__ import annotations

import functools
import logging
from typing import Optional, TYPE_CHECKING

from launch import Event, LaunchContext
from launch.actions import ExecuteLocal
from launch.events.process import ShutdownProcess

from fogros2.errors import ProviderError
from fogros2.model import NodeSpec
from fogros2.runtime.republishers import AddedProcess

if TYPE_CHECKING:
    from fogros2.runtime.session import Session
    from fogros2.runtime.streaming import Streams


class MachineInterrupted(Event):
    """
    The provider reclaims a machine of the launch, or has done so; emitted once for each machine.

    Handlers see it before the machine's ``on_interrupt`` takes effect::

        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own from now on')]))

    :param machine: the machine's name.
    :param reason: the provider's explanation.
    :param lost: True if the machine is gone; False if it still runs for some time.
    """

    name = 'fogros2.MachineInterrupted'

    def __init__(self, machine: str, reason: str, lost: bool) -> None:
        super().__init__()
        self.machine = machine
        self.reason = reason
        self.lost = lost


def react(
    event: MachineInterrupted, session: Session, streams: Streams, context: LaunchContext,
    logger: logging.Logger,
) -> list[tuple[Optional[str], NodeSpec]]:
    """
    Apply the machine's ``on_interrupt``.

    :param streams: the launch's streams; those of this machine end or move to the robot.
    :returns: nodes of streams to start, each with its machine, None for the robot.
    :raises ProviderError: ends the launch.
    """
    what = (f"the machine '{event.machine}' "
            f'{"is gone" if event.lost else "is being reclaimed"}: {event.reason}')
    if session.replacer is not None:
        logger.warning(f'{what}; a new machine will continue its nodes')
        session.replacer.on('lost' if event.lost else 'notice')
        return []
    if session.spec.on_interrupt == 'robot':
        logger.warning(f'{what}; its nodes continue on the robot')
        ended, new, lost = streams.take_over(event.machine)
        for node in ended:
            context.emit_event_sync(
                ShutdownProcess(process_matcher=functools.partial(_runs, node)))
        if lost:
            logger.warning(f"{', '.join(lost)} of '{event.machine}' no longer reaches other "
                           'machines: the robot streams it in another way')
        session.move_all()
        return new
    if event.lost:
        session.end_all()
    if session.replicated:
        logger.warning(f'{what}; the other replicas go on')
        return []
    raise ProviderError(what, "on_interrupt='robot' continues its nodes on the robot")


def _runs(node: str, action: ExecuteLocal) -> bool:
    return isinstance(action, AddedProcess) and action.node == node
