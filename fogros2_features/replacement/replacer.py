# SPDX-License-Identifier: Apache-2.0
"""Replace a machine of a launch: carry out the commands of ``steps``."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
import dataclasses
import logging
from typing import Any, Optional, Protocol, TYPE_CHECKING

from fogros2.errors import Cancelled, FogError, ProviderError
from fogros2.model import NodeSpec
from fogros2_features.replacement.checkpoints import Checkpoints, Nodes
from fogros2_features.replacement.steps import decide, Event, Replacement

if TYPE_CHECKING:
    from fogros2.deploy import Launch, RunningMachine

#: Seconds that an agent has, beyond a node's own time-outs, to end it and to report that.
GRACE = 10.0
#: Seconds of a notice for the last copy of a checkpoint.
CHECKPOINT = 20.0


class Moving(Nodes, Protocol):
    """The nodes of one machine, which move to the robot and to a new machine."""

    checkpoints: Optional[Checkpoints]
    #: The name of what goes on without the machine, '' if nothing does.
    others: str

    async def halt_all(self) -> None:
        """Let the machine end all of its processes; ``drained`` follows."""

    async def move_halted(self) -> None:
        """Let processes start on the robot: the machine no longer runs them."""

    async def stay(self) -> list[str]:
        """End, after moves under way, what the robot cannot run; return the nodes' names."""

    def replace(self, running: RunningMachine) -> None:
        """Use another machine from now on."""

    async def come_back(self) -> None:
        """Move all processes to the new machine."""


class Replacer:
    """
    The replacements of one machine, on launch's event loop.

    :param in_thread: runs a blocking function in a thread.
    :param is_over: returns whether the launch is shutting down.
    """

    def __init__(
        self, session: Moving, launch: Launch, loop: asyncio.AbstractEventLoop, *,
        in_thread: Callable[..., asyncio.Future[Any]], is_over: Callable[[], bool],
        logger: logging.Logger,
    ) -> None:
        self.state = Replacement(
            session.own.max_replacements, GRACE, session.spec.robot_timeout + GRACE)
        self._session = session
        self._launch = launch
        self._loop = loop
        self._in_thread = in_thread
        self._is_over = is_over
        self._logger = logger

    def allow(self, node: NodeSpec) -> None:
        """Allow for the time-outs of a node of the machine."""
        seconds = node.sigterm_timeout + node.sigkill_timeout + GRACE
        if self._session.checkpoints:
            seconds += CHECKPOINT
        if seconds > self.state.drain:
            self.state = dataclasses.replace(
                self.state, drain=seconds, fence=self._session.spec.robot_timeout + seconds)

    def on(self, event: Event) -> None:
        """Handle an event: carry out the commands that follow from it."""
        if self._is_over():
            return
        before = self.state
        self.state, commands = decide(before, event, self._loop.time())
        for command in commands:
            getattr(self, f'_{command}')()
        if self.state.deadline is not None and self.state.deadline != before.deadline:
            self._loop.call_at(self.state.deadline, self.on, 'time')

    def _drain(self) -> None:
        self._session.request(self._session.halt_all)

    def _move(self) -> None:
        self._session.request(self._session.move_halted)

    def _end(self) -> None:
        async def end() -> None:
            try:
                await self._in_thread(self._launch.retire, self._session.spec.name)
            except FogError as error:
                self._warn('is not deleted yet', error)
                self.on('unended')
            else:
                self.on('ended')
        self._session.request(end)

    def _retry(self) -> None:
        def end() -> None:
            if not self._is_over():
                self._end()
        self._loop.call_later(self.state.pause, end)

    def _create(self) -> None:
        async def create() -> None:
            try:
                running = await self._in_thread(self._launch.up, self._session.spec)
            except FogError as error:
                self._warn('is not replaced yet', error)
                self.on('refused')
            else:
                self._session.replace(running)
                self.on('created')
        self._session.request(create)

    def _come_back(self) -> None:
        self._session.request(self._session.come_back)

    def _give_up(self) -> None:
        name, count = self._session.spec.name, self.state.limit
        what = f"the machine '{name}' is not replaced again: max_replacements={count} is reached"

        async def give_up() -> None:
            homeless, others = await self._session.stay(), self._session.others
            if homeless and not others:
                raise ProviderError(
                    f"{what}, and {', '.join(homeless)} can't run on the robot",
                    'raise max_replacements, or install the programs on the robot')
            self._logger.error(
                f'{what}; {others} go on' if others else f'{what}; its nodes stay on the robot')
        self._session.request(give_up)

    def _warn(self, what: str, error: FogError) -> None:
        if not isinstance(error, Cancelled) and not self._is_over():
            self._logger.warning(f"the machine '{self._session.spec.name}' {what}: {error}")
