# SPDX-License-Identifier: Apache-2.0
"""Messages between relays: a line of text, then the serialized ROS message; pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
import re
from typing import NamedTuple

#: Maximum size of a message in bytes, and of the line before it; maximum number of messages that
#: publishers keep for subscribers that come later.
LARGEST, LINE, DEEPEST = 99_999_999, 1024, 99
_LINE = re.compile(r'(/[\w/]+) ([a-z]\w*/msg/[A-Z]\w*) ([01]) (\d\d?) (\d{1,8})\n', re.ASCII)


class Form(NamedTuple):
    """
    Type and QoS of a topic's messages.

    :param kind: the type, such as ``nav_msgs/msg/OccupancyGrid``.
    :param reliable: whether all publishers are reliable.
    :param kept: how many messages the publishers keep for subscribers that come later (transient
        local); 0: none.
    """

    kind: str
    reliable: bool
    kept: int


def encode(topic: str, form: Form, size: int) -> bytes:
    """Return the line before a message of ``size`` bytes."""
    return f'{topic} {form.kind} {form.reliable:d} {form.kept} {size}\n'.encode()


def decode(line: bytes) -> tuple[str, Form, int]:
    """
    Return topic, form and size of the message that follows a line.

    :raises ValueError: the line has another form, or a number is too large.
    """
    match = _LINE.fullmatch(line.decode())
    if match is None:
        raise ValueError(f'{line[:80]!r} is no message')
    topic, kind, reliable, kept, size = match.groups()
    return topic, Form(kind, reliable == '1', int(kept)), int(size)


class Echoes:
    """
    The messages that a relay has published, and so hears itself; all times in seconds.

    ROS does not tell who has published a serialized message, so its content does.
    """

    #: Time in which the relay hears what it has published, and number of contents to remember.
    DELAY, MOST = 5.0, 4096

    def __init__(self) -> None:
        self._published: deque[tuple[float, int]] = deque(maxlen=self.MOST)

    def add(self, now: float, data: bytes) -> None:
        """Record a message that is about to be published."""
        self._published.append((now, hash(data)))

    def restart(self, now: float, latched: Iterable[int]) -> None:
        """
        Forget all messages but latched ones, which a new subscription hears once more.

        :param latched: hashes of their contents.
        """
        self._published.clear()
        self._published.extend((now, content) for content in latched)

    def heard(self, now: float, data: bytes) -> bool:
        """Return whether a message that was heard is one that the relay has published."""
        while self._published and self._published[0][0] < now - self.DELAY:
            self._published.popleft()
        for number, (_, content) in enumerate(self._published):
            if content == hash(data):
                del self._published[number]
                return True
        return False
