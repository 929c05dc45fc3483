# SPDX-License-Identifier: Apache-2.0
"""
Send large images and point clouds in slices, as fast as the link carries them.

DDS sends all fragments of a message at once. On a slow link, most fragments of a large message
find a full queue, and the repetitions do so too. So the message leaves in slices, each a message
of its own. The receivers acknowledge each slice, and the acknowledgements clock the next ones, as
in TCP.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import dataclasses
import math
import secrets
import struct
import threading
import time
from typing import Any, Optional

from rclpy.publisher import Publisher
from std_msgs.msg import UInt8MultiArray, UInt64MultiArray

from image_transport_h264 import message
from image_transport_h264.cdr import CdrError
from image_transport_h264.lazy import LazyNode, LONGEST, SLICES_QOS, Tap
from image_transport_h264.message import ACKNOWLEDGED, SLICES
from image_transport_h264.pacing import Pace, Sent
from image_transport_h264.rate import MOST_RECEIVERS

#: Bytes of a slice at first and at the least; 10 Mbit/s carry 76 of them in a second.
LEAST = 1 << 14
#: Bytes of the largest message, and number of senders whose messages are put together at once.
LARGEST, OPEN = 1 << 28, 4
#: Seconds that a slice takes: below QUICK the next message has larger slices, above SLOW smaller.
QUICK, SLOW = 0.004, 0.1
#: Slices in the link's queue above which fewer are sent; while one waits, the link has no pause.
QUEUED = 1.25
#: Fine slices: at least so many of a message, if they do not fit a datagram of Fast DDS's, whose
#: bytes this is without headers; and slices in flight.
MANY, DATAGRAM, AT_LEAST = 8, 8192, 2
#: Factor from one size of slices to the next.
STEP = 4
#: Sender's identity, number of the slice, size of the message, place of the slice in it.
HEADER = struct.Struct('>QQII')

#: Seconds since a message's first slice left, and of the quickest recent slice; 0: unknown.
Arrived = Callable[[float, float], None]


def _ignore(*_: float) -> None:
    """Do nothing."""


class SliceSender:
    """
    Publish serialized messages in slices.

    :param stream: the topic whose messages are sent.
    :param changed: callback for a change of the subscribers.
    :param fine: keep slices small, so that packets of other streams wait little behind them.
    """

    def __init__(self, node: LazyNode, stream: str, changed: Callable[[], None],
                 fine: bool = False) -> None:
        self._node, self._changed, self._fine = node, changed, fine
        self._known = 0
        self._publisher = node.offer(
            UInt8MultiArray, f'{stream}/{SLICES}', SLICES_QOS, self._matched)
        node.create_subscription(
            UInt64MultiArray, f'{stream}/{ACKNOWLEDGED}', self._heard, SLICES_QOS)
        self._identity = secrets.randbits(63)
        self._number = 0
        self._size = LEAST
        self._pace = Pace(QUEUED)
        self._under_way: deque[tuple[int, Sent]] = deque()
        #: Of the messages under way, the last slice, when the first one left, and the callback.
        self._messages: deque[tuple[int, float, Arrived]] = deque()
        #: The last acknowledgement of each receiver: number of the slice, and when it came (s).
        self._heard_of: dict[int, tuple[int, float]] = {}
        #: Which receiver sets the pace: the slowest one, unless it hangs.
        self._pacemaker: Callable[..., int] = min
        self._news = threading.Condition()

    def replace(self, whole: Publisher) -> bool:
        """Return whether all subscribers of the whole messages take slices too."""
        return self._node.subscribers(self._publisher) >= self._node.subscribers(whole)

    def send_to_all(self, whole: Publisher, data: bytes, leaves: Callable[[int], None] = _ignore,
                    arrived: Arrived = _ignore) -> None:
        """Send in slices, or whole if a subscriber of the whole messages takes no slices."""
        if self.replace(whole):
            self.send(data, leaves, arrived)
            return
        leaves(len(data))
        begin = time.monotonic()
        self._node.put_out(whole, data)
        self._node.all_acknowledged(whole)
        arrived(time.monotonic() - begin, 0.0)

    def send(self, data: bytes, leaves: Callable[[int], None] = _ignore,
             arrived: Arrived = _ignore) -> None:
        """
        Publish a message, and wait until most has arrived; give up one that does not arrive.

        :param leaves: called with the bytes of each slice before it leaves; may wait.
        :param arrived: called when all receivers have the message, or when it is given up.
        """
        begin = time.monotonic()
        # all of a size, as the pace compares their times
        count = -(-len(data) // self._size)
        if self._fine:
            count = max(count, min(MANY, -(-len(data) // DATAGRAM)))
        size = -(-len(data) // count)
        with self._news:
            self._pacemaker = min
            self._messages.append((self._number + count, begin, arrived))
        for place in range(0, len(data), size):
            part = data[place:place + size]
            leaves(len(part))
            with self._news:
                self._number += 1
                self._under_way.append((self._number, self._pace.sent(time.monotonic())))
            self._node.put_out(self._publisher, message.in_pieces(
                HEADER.pack(self._identity, self._number, len(data), place) + part))
            with self._news:
                if self._news.wait_for(self._may_send, LONGEST):
                    continue
                # a receiver that hangs keeps the rest of the message from no other one
                self._pacemaker = max
                self._settle(time.monotonic())
                if not self._may_send():
                    # the link is cut or slower than before, or nobody listens any more
                    self._under_way.clear()
                    if self._heard_of and self._messages:
                        self._messages.pop()[2](LONGEST, 0.0)
                    self._messages.clear()
                    self._pace = Pace(QUEUED)
                    self._adapt(math.inf)
                    return
        seconds = (time.monotonic() - begin) * size / len(data)
        if count > 1 or seconds > SLOW:  # larger than the message would change nothing
            self._adapt(seconds)

    def _may_send(self) -> bool:
        """Return whether another slice may leave; fine ones keep the link busy until an answer."""
        return self._pace.may_send() or self._fine and len(self._under_way) < AT_LEAST

    def _adapt(self, seconds: float) -> None:
        """Choose the size of the next message's slices by the time that one took."""
        size = self._size * STEP if seconds < QUICK else self._size // STEP
        if QUICK <= seconds <= SLOW or not LEAST <= size <= LARGEST or self._fine:
            return
        with self._news:
            # times of slices of another size say nothing about these
            self._size, self._pace = size, Pace(QUEUED)
            self._under_way.clear()

    def _matched(self) -> None:
        before, self._known = self._known, self._node.subscribers(self._publisher)
        if self._known < before:
            # do not wait for the receiver that has gone; the others acknowledge again
            with self._news:
                self._pacemaker = max
                self._settle(time.monotonic())
                self._messages.clear()
                self._heard_of.clear()
                self._news.notify()
        self._changed()

    def _heard(self, feedback: UInt64MultiArray) -> None:
        """Take an acknowledgement."""
        if len(feedback.data) != 3 or feedback.data[1] != self._identity:
            return
        receiver, now = feedback.data[0], time.monotonic()
        with self._news:
            if feedback.data[2] > self._number:
                return
            self._heard_of = {other: (number, when) for other, (number, when)
                              in self._heard_of.items() if when > now - LONGEST}
            if receiver not in self._heard_of and len(self._heard_of) == MOST_RECEIVERS:
                return
            self._heard_of[receiver] = feedback.data[2], now
            self._settle(now)
            self._news.notify()

    def _settle(self, now: float) -> None:
        """Report slices that have arrived to the pace, and messages to their senders."""
        last = self._pacemaker(
            (number for number, _ in self._heard_of.values()), default=0)
        while self._under_way and self._under_way[0][0] <= last:
            self._pace.acknowledged(self._under_way.popleft()[1], now)
        while self._messages and self._messages[0][0] <= last:
            _, begin, arrived = self._messages.popleft()
            arrived(now - begin, self._pace.quickest)


@dataclasses.dataclass
class _Message:
    size: int
    number: int
    data: bytearray


class Assembler:
    """
    Put messages together from slices, which come in order; of each sender the newest message.

    :param largest: bytes of all messages together.
    """

    def __init__(self, largest: int = LARGEST) -> None:
        self._largest = largest
        self._messages: dict[int, _Message] = {}

    def add(self, part: bytes) -> tuple[int, int, Optional[bytes]]:
        """
        Return sender and number of a slice, and the message that it completes.

        :raises struct.error: the slice is too short.
        """
        sender, number, size, place = HEADER.unpack_from(part)
        entry = self._messages.pop(sender, None)
        if place == 0 and size <= self._largest:
            entry = _Message(size, number, bytearray())
        # Of a message that begins before the subscription, or that lacks a slice, drop the rest.
        if entry is None or (size, number, place) != (entry.size, entry.number, len(entry.data)):
            return sender, number, None
        entry.data += part[HEADER.size:]
        entry.number += 1
        if len(entry.data) >= size:
            return sender, number, bytes(entry.data) if len(entry.data) == size else None
        self._messages[sender] = entry
        if len(self._messages) > OPEN:
            del self._messages[next(iter(self._messages))]
        if sum(len(each.data) for each in self._messages.values()) > self._largest:
            self._messages.clear()
        return sender, number, None


class SliceReceiver:
    """
    Receive messages in slices, and acknowledge these.

    :param whole: called with each complete serialized message.
    :param largest: bytes of the largest one.
    """

    def __init__(self, node: LazyNode, stream: str, whole: Callable[[bytes], None],
                 largest: int = LARGEST) -> None:
        self._node, self._whole = node, whole
        self._feedback = node.create_publisher(
            UInt64MultiArray, f'{stream}/{ACKNOWLEDGED}', SLICES_QOS)
        self._identity = secrets.randbits(63)
        self._assembler = Assembler(largest)
        self.tap = Tap(node, UInt8MultiArray, f'{stream}/{SLICES}', SLICES_QOS, self._take,
                       adapt=False)

    def _take(self, coded: Any) -> None:
        try:
            sender, number, whole = self._assembler.add(message.piece(coded))
        except (CdrError, struct.error) as error:
            self._node.complain('malformed slice', f'slice not shown: {error}')
            return
        self._node.put_out(self._feedback, UInt64MultiArray(
            data=[self._identity, sender, number]))
        if whole is not None:
            self._whole(whole)
