# SPDX-License-Identifier: Apache-2.0
"""Handle the preemption of a machine: emit an event, and move its nodes or end the launch."""

from __future__ import annotations

from collections.abc import Callable
import logging
from typing import TYPE_CHECKING

from launch import Event
from launch.actions import ExecuteLocal

from fogros2.errors import ProviderError

if TYPE_CHECKING:
    from fogros2.runtime.session import Session


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
    event: MachineInterrupted, session: Session,
    take_over: Callable[[str], list[ExecuteLocal]], logger: logging.Logger,
) -> list[ExecuteLocal]:
    """
    Apply the machine's ``on_interrupt``.

    :param take_over: see :meth:`fogros2.runtime.coordinator.Coordinator.take_over`.
    :returns: processes to start.
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
        new = take_over(event.machine)
        session.move_all()
        return new
    if event.lost:
        session.end_all()
    if session.replicated:
        logger.warning(f'{what}; the other replicas go on')
        return []
    raise ProviderError(what, "on_interrupt='robot' continues its nodes on the robot")
