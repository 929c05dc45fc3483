# SPDX-License-Identifier: Apache-2.0
"""Points in time."""

from functools import total_ordering
from typing import Any

from rclpy.clock_type import ClockType
from rclpy.constants import S_TO_NS
from rclpy.duration import Duration

__all__ = ['ClockType', 'Time']


@total_ordering
class Time:
    """
    A point in time of one kind of clock; only times of the same kind can be compared.

    :raises ValueError: if it is negative.
    :raises OverflowError: if it doesn't fit 63 bits of nanoseconds.
    """

    def __init__(self, *, seconds: int | float = 0, nanoseconds: int = 0,
                 clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        if not isinstance(clock_type, ClockType):
            raise TypeError('Clock type must be a ClockType enum')
        if seconds < 0:
            raise ValueError('Seconds value must not be negative')
        if nanoseconds < 0:
            raise ValueError('Nanoseconds value must not be negative')
        total = int(seconds * S_TO_NS) + int(nanoseconds)
        if total >= 2 ** 63:
            raise OverflowError('Total nanoseconds value is too large to store in C time point.')
        self._nanoseconds = total
        self._clock_type = clock_type

    @property
    def nanoseconds(self) -> int:
        """Nanoseconds since the clock's epoch."""
        return self._nanoseconds

    clock_type = property(lambda self: self._clock_type, doc='The kind of clock.')

    def seconds_nanoseconds(self) -> tuple[int, int]:
        """Give seconds and the nanoseconds beyond."""
        return divmod(self._nanoseconds, S_TO_NS)

    def __repr__(self) -> str:
        return f'Time(nanoseconds={self._nanoseconds}, clock_type={self._clock_type.name})'

    def __add__(self, other: Duration) -> 'Time':
        if not isinstance(other, Duration):
            return NotImplemented
        try:
            return Time(nanoseconds=self._nanoseconds + other.nanoseconds,
                        clock_type=self._clock_type)
        except OverflowError as error:
            raise OverflowError('Addition leads to overflow in C storage.') from error

    __radd__ = __add__

    def __sub__(self, other: 'Time | Duration') -> Any:
        if isinstance(other, Time):
            if self._clock_type != other._clock_type:
                raise TypeError("Can't subtract times with different clock types")
            return Duration(nanoseconds=self._nanoseconds - other._nanoseconds)
        if not isinstance(other, Duration):
            return NotImplemented
        try:
            return Time(nanoseconds=self._nanoseconds - other.nanoseconds,
                        clock_type=self._clock_type)
        except ValueError as error:
            raise ValueError('Subtraction leads to negative time.') from error

    def _other(self, other: 'Time') -> int:
        if self._clock_type != other._clock_type:
            raise TypeError("Can't compare times with different clock types")
        return other._nanoseconds

    def __eq__(self, other: object) -> bool:
        return self._nanoseconds == self._other(other) if isinstance(other, Time) \
            else NotImplemented

    def __lt__(self, other: 'Time') -> bool:
        return self._nanoseconds < self._other(other) if isinstance(other, Time) \
            else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def to_msg(self) -> Any:
        """Convert to ``builtin_interfaces.msg.Time``."""
        from builtin_interfaces.msg import Time as Message
        seconds, nanoseconds = self.seconds_nanoseconds()
        return Message(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, msg: Any, clock_type: ClockType = ClockType.ROS_TIME) -> 'Time':
        """Convert from ``builtin_interfaces.msg.Time``."""
        from builtin_interfaces.msg import Time as Message
        if not isinstance(msg, Message):
            raise TypeError('Must pass a builtin_interfaces.msg.Time object')
        return cls(seconds=msg.sec, nanoseconds=msg.nanosec, clock_type=clock_type)
