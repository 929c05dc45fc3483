# SPDX-License-Identifier: Apache-2.0
"""Timers, and rates made of them."""

from collections.abc import Callable
import threading
from typing import Any

from rclpy._entity import Entity, Work
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle, RCLError, ROSInterruptException


class Timer(Entity):
    """Calls back in a period of its clock's time; made by :meth:`.Node.create_timer`."""

    def __init__(self, callback: Callable[..., Any] | None, callback_group: CallbackGroup | None,
                 timer_period_ns: int, clock: Clock, *, context: Context | None = None,
                 autostart: bool = True, wake: Callable[[], None] | None = None) -> None:
        if timer_period_ns < 0:
            raise RCLError('failed to create timer: timer period must be non-negative')
        super().__init__()
        self.callback = callback
        self.callback_group = callback_group
        self._clock = clock
        self._period = int(timer_period_ns)
        self._wake = wake or (lambda: None)
        self._cancelled = not autostart
        self._last = clock._now()
        self._next = self._last + self._period
        clock._jumps.append(self._jumped)

    def _jumped(self, source_changed: bool) -> None:
        now = self._clock._now()
        if source_changed or now < self._last:
            self._last = now  # times before and after can't be compared
            self._next = now + self._period
        self._wake()

    def _take(self, executor: Any) -> Work | None:
        if not self.is_ready() or self._destroyed:
            return None
        now = self._clock._now()
        self._last = now
        self._next += self._period
        if self._next < now:  # skip the calls that were missed
            if self._period == 0:
                self._next = now
            else:
                self._next += (now - self._next) // self._period * self._period + self._period
        return (self.callback, (), None) if self.callback is not None else None

    def destroy(self) -> None:
        """Free it; a program calls :meth:`.Node.destroy_timer`."""
        if not self._destroyed:
            self._destroyed = True
            self._clock._jumps.remove(self._jumped)

    @property
    def clock(self) -> Clock:
        """Its clock."""
        return self._clock

    @property
    def timer_period_ns(self) -> int:
        """Its period in nanoseconds; a new one holds from the next call on."""
        return self._period

    @timer_period_ns.setter
    def timer_period_ns(self, value: int) -> None:
        self._period = int(value)
        self._wake()

    def is_ready(self) -> bool:
        """Say whether the callback is to be called."""
        return not self._cancelled and self._clock._now() >= self._next

    def is_canceled(self) -> bool:
        """Say whether it was cancelled."""
        return self._cancelled

    def cancel(self) -> None:
        """Call back no more, until :meth:`reset`."""
        self._cancelled = True

    def reset(self) -> None:
        """Start anew: the next call is one period away."""
        self._last = self._clock._now()
        self._next = self._last + self._period
        self._cancelled = False
        self._wake()

    def time_since_last_call(self) -> int:
        """Give the nanoseconds since the last call."""
        return self._clock._now() - self._last

    def time_until_next_call(self) -> int | None:
        """Give the nanoseconds until the next call, negative if it is late; None if cancelled."""
        return None if self._cancelled else self._next - self._clock._now()

    def _left(self) -> int | None:
        """Nanoseconds an executor may sleep; None: this timer doesn't end it."""
        if self._cancelled or self._destroyed:
            return None
        left = self._next - self._clock._now()
        if left > 0 and self._clock._override is not None:
            return None  # a simulator's clock wakes the executor itself
        return max(left, 0)


class Rate:
    """Sleeps in a fixed rate; made by :meth:`.Node.create_rate`."""

    def __init__(self, timer: Timer, *, context: Context) -> None:
        self._timer = timer
        self._is_destroyed = False
        self._condition = threading.Condition()
        self._ticks = 0
        self._timer.callback = self._tick
        self._context = context
        context._wakers.add(self._wake)

    def _tick(self) -> None:
        self._ticks += 1
        self._wake()

    def _wake(self) -> None:
        with self._condition:
            self._condition.notify_all()

    def destroy(self) -> None:
        """End all sleeps."""
        self._is_destroyed = True
        self._wake()

    def sleep(self) -> None:
        """
        Sleep until the timer ticks; an executor has to run in another thread.

        :raises ROSInterruptException: if the context is shut down.
        """
        if self._is_destroyed:
            raise RuntimeError('Rate cannot sleep because it has been destroyed')
        if self._timer._destroyed:
            raise InvalidHandle('Rate cannot sleep because the timer has been destroyed')
        seen = self._ticks
        with self._condition:
            self._condition.wait_for(lambda: self._ticks != seen or self._is_destroyed
                                     or not self._context.ok())
        if not self._context.ok():
            raise ROSInterruptException()
