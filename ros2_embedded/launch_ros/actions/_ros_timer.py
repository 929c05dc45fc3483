# SPDX-License-Identifier: Apache-2.0
"""A timer that counts by ROS time."""
from __future__ import annotations

import asyncio
from typing import Any, Iterable, List, Optional, Union

from launch.actions import TimerAction
from launch.events import TimerEvent
from launch.frontend import expose_action
from launch.launch_context import LaunchContext
from launch.launch_description_entity import LaunchDescriptionEntity
from launch.some_substitutions_type import SomeSubstitutionsType
from launch.utilities.type_utils import perform_typed_substitution

from ..ros_adapters import get_ros_node


@expose_action('ros_timer')
class ROSTimer(TimerAction):
    """Visits actions when a period of ROS time, in seconds, has passed."""

    def __init__(
        self, *, period: Union[float, SomeSubstitutionsType],
        actions: Iterable[LaunchDescriptionEntity], **kwargs: Any
    ) -> None:
        super().__init__(period=period, actions=actions, **kwargs)
        self.__timer_future: Optional[asyncio.Future[bool]] = None

    def describe(self) -> str:
        return f'ROSTimer(period={self.period}, actions=<actions>)'

    def __on_timer(self) -> None:
        if self.__timer_future is not None and not self.__timer_future.done():
            self.__timer_future.set_result(True)

    async def _wait_to_fire_event(self, context: LaunchContext) -> None:
        assert self._canceled_future is not None and self._completed_future is not None
        assert self.__timer_future is not None
        loop = context.asyncio_loop
        timer = get_ros_node(context).create_timer(
            perform_typed_substitution(context, self.period, float),
            lambda: loop.call_soon_threadsafe(self.__on_timer))
        await asyncio.wait(
            [self._canceled_future, self.__timer_future],
            return_when=asyncio.FIRST_COMPLETED)
        timer.cancel()
        if not self._canceled_future.done():
            await context.emit_event(TimerEvent(timer_action=self))
        self._completed_future.set_result(None)

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        self.__timer_future = context.asyncio_loop.create_future()
        return super().execute(context)
