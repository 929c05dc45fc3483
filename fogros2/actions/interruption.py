# SPDX-License-Identifier: Apache-2.0
"""A machine that its provider takes away: what launch files learn of it, and what is done."""

from __future__ import annotations

import functools
import logging
from typing import Optional, TYPE_CHECKING

from launch import Event, LaunchContext
from launch.actions import ExecuteLocal
from launch.events.process import ShutdownProcess

from fogros2.actions.carriers import Carrier
from fogros2.errors import ProviderError
from fogros2.model import NodeSpec

if TYPE_CHECKING:
    from fogros2.actions.session import Session
    from fogros2.actions.streaming import Streams


class MachineInterrupted(Event):
    """
    The provider takes a machine of the launch away, or has; emitted once for each.

    Handlers see it before the machine's ``on_interrupt`` has its effect::

        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own from now on')]))

    :param machine: its name.
    :param reason: in the provider's words.
    :param lost: whether it is gone already; False while it runs for some time still.
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
    Do what the machine's ``on_interrupt`` says.

    :param streams: of the launch; those of this machine end, or are the robot's from now on.
    :returns: nodes of streams to start, each with its machine, None for the robot.
    :raises ProviderError: to end the launch.
    """
    what = (f"the machine '{event.machine}' "
            f'{"is gone" if event.lost else "is being taken away"}: {event.reason}')
    if session.spec.on_interrupt == 'robot':
        logger.warning(f'{what}; its nodes go on on the robot')
        ended, new, left = streams.take_over(event.machine)
        for node in ended:
            context.emit_event_sync(
                ShutdownProcess(process_matcher=functools.partial(_carries, node)))
        if left:
            logger.warning(f"{', '.join(left)} of '{event.machine}' reaches no other machine any "
                           'more: the robot streams it in another way')
        session.move_all()
        return new
    if event.lost:
        session.end_all()
    raise ProviderError(what, "on_interrupt='robot' would have its nodes go on on the robot")


def _carries(node: str, action: ExecuteLocal) -> bool:
    return isinstance(action, Carrier) and action.node == node
