# SPDX-License-Identifier: Apache-2.0
"""Clocks: the system's, a steady one, and ROS time, which a simulator can take over."""

from collections.abc import Callable
import threading
import time
from typing import Any

from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import NotInitializedException
from rclpy.time import Time
from rclpy.utilities import get_default_context
from rosidl_embedded.lacking import lacking

__all__ = ['Clock', 'ClockType', 'ROSClock']
__getattr__ = lacking(__name__, 'ClockChange JumpHandle JumpThreshold TimeJump')

Jumped = Callable[[bool], None]
"""Called after a jump: whether the time's source is another one now."""


class Clock:
    """A clock; of type ROS_TIME it is a :class:`ROSClock`."""

    _clock_type: ClockType
    _jumps: list[Jumped]
    _override: int | None  # nanoseconds, while a simulator is the source
    _simulated: int  # the last time it gave

    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> 'Clock':
        if not isinstance(clock_type, ClockType):
            raise TypeError('Clock type must be a ClockType enum')
        self = super().__new__(ROSClock if clock_type is ClockType.ROS_TIME else cls)
        self._clock_type = clock_type
        self._jumps = []
        self._override, self._simulated = None, 0
        return self

    @property
    def clock_type(self) -> ClockType:
        """The kind of clock."""
        return self._clock_type

    def __repr__(self) -> str:
        return f'Clock(clock_type={self._clock_type.name})'

    def _now(self) -> int:
        if self._override is not None:
            return self._override
        if self._clock_type is ClockType.STEADY_TIME:
            return time.monotonic_ns()
        return time.time_ns()

    def now(self) -> Time:
        """Read the clock."""
        return Time(nanoseconds=self._now(), clock_type=self._clock_type)

    def sleep_until(self, until: Time, context: Context | None = None) -> bool:
        """
        Sleep until a time of this clock.

        :returns: False if it ended earlier: by shutdown, or a change of the time's source.
        :raises NotInitializedException: if the context isn't initialized.
        """
        context = get_default_context() if context is None else context
        if not context.ok():
            raise NotInitializedException()
        if until.clock_type != self._clock_type:
            raise ValueError("until's clock type does not match this clock's type")
        woken = threading.Event()
        changed = False

        def jumped(source_changed: bool) -> None:
            nonlocal changed
            changed = changed or source_changed
            woken.set()

        context._wakers.add(woken.set)
        self._jumps.append(jumped)
        try:
            while context.ok() and not changed:
                left = until.nanoseconds - self._now()
                if left <= 0:
                    return True
                woken.wait(None if self._override is not None else min(left / 1e9, 3600.0))
                woken.clear()
        finally:
            self._jumps.remove(jumped)
            context._wakers.discard(woken.set)
        return False

    def sleep_for(self, rel_time: Duration, context: Context | None = None) -> bool:
        """Sleep for a span of this clock's time; see :meth:`sleep_until`."""
        return self.sleep_until(self.now() + rel_time, context)


class ROSClock(Clock):
    """The system's time, or a simulator's while that is active."""

    def __new__(cls, **_: Any) -> 'ROSClock':
        self = super().__new__(Clock, clock_type=ClockType.ROS_TIME)
        assert isinstance(self, ROSClock)
        return self

    @property
    def ros_time_is_active(self) -> bool:
        """Whether a simulator gives the time."""
        return self._override is not None

    def _jump(self, override: int | None) -> None:
        changed = self.ros_time_is_active == (override is None)
        self._override = override
        for jumped in list(self._jumps):
            jumped(changed)

    def _set_ros_time_is_active(self, enabled: bool) -> None:
        if enabled != self.ros_time_is_active:
            self._jump(self._simulated if enabled else None)

    def set_ros_time_override(self, time: Time) -> None:
        """Say what time it is while a simulator gives the time."""
        if not isinstance(time, Time):
            raise TypeError(
                f'Time must be specified as rclpy.time.Time. Received type: {type(time)}')
        self._simulated = time.nanoseconds
        if self._override is not None:
            self._jump(time.nanoseconds)
