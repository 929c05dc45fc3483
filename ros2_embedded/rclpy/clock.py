# SPDX-License-Identifier: Apache-2.0
"""Clocks: the system's, a steady one, and ROS time, which a simulator can take over."""

from collections.abc import Callable
from enum import IntEnum
import threading
import time
from types import TracebackType
from typing import Any, NamedTuple

from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import NotInitializedException
from rclpy.time import Time
from rclpy.utilities import get_default_context

__all__ = ['Clock', 'ClockChange', 'ClockType', 'JumpHandle', 'JumpThreshold', 'ROSClock',
           'TimeJump']


class ClockChange(IntEnum):
    """What a jump did to the clock's source."""

    ROS_TIME_NO_CHANGE = 1
    ROS_TIME_ACTIVATED = 2
    ROS_TIME_DEACTIVATED = 3
    SYSTEM_TIME_NO_CHANGE = 4


class JumpThreshold:
    """How far a clock has to jump for a callback to be called."""

    def __init__(self, *, min_forward: Duration | None, min_backward: Duration | None,
                 on_clock_change: bool = True) -> None:
        if min_forward is not None and min_forward.nanoseconds <= 0:
            raise ValueError('min_forward must be a positive non-zero duration')
        if min_backward is not None and min_backward.nanoseconds >= 0:
            raise ValueError('min_backward must be a negative non-zero duration')
        if min_forward is None and min_backward is None and not on_clock_change:
            raise ValueError('At least one jump threshold must be enabled')
        self.min_forward = min_forward
        self.min_backward = min_backward
        self.on_clock_change = on_clock_change


class TimeJump(NamedTuple):
    """A jump of a clock: what it did to the clock's source, and how far it was."""

    clock_change: ClockChange
    delta: Duration


class JumpHandle:
    """A callback for jumps, until it is unregistered."""

    def __init__(self, *, clock: 'Clock', threshold: JumpThreshold,
                 pre_callback: Callable[[], None] | None,
                 post_callback: Callable[[TimeJump], None] | None) -> None:
        if pre_callback is None and post_callback is None:
            raise ValueError('One of pre_callback or post_callback must be callable')
        if pre_callback is not None and not callable(pre_callback):
            raise ValueError('pre_callback must be callable if given')
        if post_callback is not None and not callable(post_callback):
            raise ValueError('post_callback must be callable if given')
        self._clock: Clock | None = clock
        self._threshold = threshold
        self._before, self._after = pre_callback, post_callback
        clock._jumps.append(self)

    def _concerned(self, change: ClockChange, delta: int) -> bool:
        limits = self._threshold
        if change in (ClockChange.ROS_TIME_ACTIVATED, ClockChange.ROS_TIME_DEACTIVATED):
            return limits.on_clock_change
        return bool(
            limits.min_forward and delta >= limits.min_forward.nanoseconds
            or limits.min_backward and delta <= limits.min_backward.nanoseconds)

    def unregister(self) -> None:
        """Stop being called."""
        if self._clock is not None:
            self._clock._jumps.remove(self)
            self._clock = None

    def __enter__(self) -> 'JumpHandle':
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.unregister()


class Clock:
    """A clock; of type ROS_TIME it is a :class:`ROSClock`."""

    _clock_type: ClockType
    _jumps: list[JumpHandle]
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

    def create_jump_callback(
            self, threshold: JumpThreshold, *, pre_callback: Callable[[], None] | None = None,
            post_callback: Callable[[TimeJump], None] | None = None) -> JumpHandle:
        """Call before and after jumps that exceed a threshold."""
        return JumpHandle(clock=self, threshold=threshold, pre_callback=pre_callback,
                          post_callback=post_callback)

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

        def jumped(jump: TimeJump) -> None:
            nonlocal changed
            changed = changed or jump.clock_change in (
                ClockChange.ROS_TIME_ACTIVATED, ClockChange.ROS_TIME_DEACTIVATED)
            if changed or self.now() >= until:
                woken.set()

        context._wakers.add(woken.set)
        limits = JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=None)
        try:
            with self.create_jump_callback(limits, post_callback=jumped):
                while context.ok() and not changed:
                    left = until.nanoseconds - self._now()
                    if left <= 0:
                        return True
                    woken.wait(None if self._override is not None else min(left / 1e9, 3600.0))
                    woken.clear()
        finally:
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

    def _jump(self, override: int | None, change: ClockChange) -> None:
        before = self._now()
        delta = (time.time_ns() if override is None else override) - before
        concerned = [jump for jump in self._jumps if jump._concerned(change, delta)]
        for jump in concerned:
            if jump._before is not None:
                jump._before()
        self._override = override
        for jump in concerned:
            if jump._after is not None:
                jump._after(TimeJump(change, Duration(nanoseconds=delta)))

    def _set_ros_time_is_active(self, enabled: bool) -> None:
        if enabled and self._override is None:
            self._jump(self._simulated, ClockChange.ROS_TIME_ACTIVATED)
        elif not enabled and self._override is not None:
            self._jump(None, ClockChange.ROS_TIME_DEACTIVATED)

    def set_ros_time_override(self, time: Time) -> None:
        """Say what time it is while a simulator gives the time."""
        if not isinstance(time, Time):
            raise TypeError(
                f'Time must be specified as rclpy.time.Time. Received type: {type(time)}')
        self._simulated = time.nanoseconds
        if self._override is not None:
            self._jump(time.nanoseconds, ClockChange.ROS_TIME_NO_CHANGE)
