# SPDX-License-Identifier: Apache-2.0
"""Spans of time."""

from functools import total_ordering
from typing import Any

from rclpy.constants import S_TO_NS


@total_ordering
class Duration:
    """
    A span of time in nanoseconds, from -2**63 to 2**63 - 1.

    :raises OverflowError: if it is longer than that.
    """

    def __init__(self, *, seconds: int | float = 0, nanoseconds: int = 0) -> None:
        total = int(seconds * S_TO_NS) + int(nanoseconds)
        if not -2 ** 63 <= total < 2 ** 63:
            raise OverflowError('Total nanoseconds value is too large to store in C duration.')
        self._nanoseconds = total

    @property
    def nanoseconds(self) -> int:
        """The whole span."""
        return self._nanoseconds

    def __repr__(self) -> str:
        return f'Duration(nanoseconds={self._nanoseconds})'

    def __str__(self) -> str:
        return 'Infinite' if self == Infinite else f'{self._nanoseconds} nanoseconds'

    def __eq__(self, other: object) -> bool:
        return self._nanoseconds == other._nanoseconds if isinstance(other, Duration) \
            else NotImplemented

    def __lt__(self, other: object) -> bool:
        return self._nanoseconds < other._nanoseconds if isinstance(other, Duration) \
            else NotImplemented

    def __hash__(self) -> int:
        return hash(self._nanoseconds)

    def to_msg(self) -> Any:
        """Convert to ``builtin_interfaces.msg.Duration``."""
        from builtin_interfaces.msg import Duration as Message
        seconds, nanoseconds = divmod(self._nanoseconds, S_TO_NS)
        return Message(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, msg: Any) -> 'Duration':
        """Convert from ``builtin_interfaces.msg.Duration``."""
        from builtin_interfaces.msg import Duration as Message
        if not isinstance(msg, Message):
            raise TypeError('Must pass a builtin_interfaces.msg.Duration object')
        return cls(seconds=msg.sec, nanoseconds=msg.nanosec)


Infinite = Duration(nanoseconds=2 ** 63 - 1)
