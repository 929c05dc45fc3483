# SPDX-License-Identifier: Apache-2.0
"""
Send large images in slices, as fast as the link carries them.

DDS sends all fragments of a message at once. On a slow link, most fragments of a large image find
a full queue, and the repetitions do so too. So the image leaves in slices, each a message of its
own. The receivers acknowledge each slice, and the acknowledgements clock the next ones, as in TCP.
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
#: Bytes of the largest image.
LARGEST = 1 << 28
#: Seconds that a slice takes: below QUICK the next image has larger ones, above SLOW smaller ones.
QUICK, SLOW = 0.004, 0.1
#: Slices in the link's queue above which fewer are sent; while one waits, the link has no pause.
QUEUED = 1.25
#: Factor from one size of slices to the next.
STEP = 4
#: Sender's identity, number of the slice, size of the image, place of the slice in it.
_HEADER = struct.Struct('>QQII')


class SliceSender:
    """
    Publish serialized messages in slices.

    :param stream: the topic whose messages are sent.
    :param changed: callback for a change of the subscribers.
    """

    def __init__(self, node: LazyNode, stream: str, changed: Callable[[], None]) -> None:
        self._node = node
        self._publisher = node.offer(
            UInt8MultiArray, f'{stream}/{SLICES}', SLICES_QOS, changed)
        node.create_subscription(
            UInt64MultiArray, f'{stream}/{ACKNOWLEDGED}', self._heard, SLICES_QOS)
        self._identity = secrets.randbits(63)
        self._number = 0
        self._size = LEAST
        self._pace = Pace(QUEUED)
        self._under_way: deque[tuple[int, Sent]] = deque()
        #: The last acknowledgement of each receiver: number of the slice, and when it came (s).
        self._heard_of: dict[int, tuple[int, float]] = {}
        #: Which receiver sets the pace: the slowest one, unless it hangs.
        self._pacemaker: Callable[..., int] = min
        self._news = threading.Condition()

    def replace(self, whole: Publisher) -> bool:
        """Return whether all subscribers of the whole messages take slices too."""
        return self._node.subscribers(self._publisher) >= self._node.subscribers(whole)

    def send(self, data: bytes) -> None:
        """Publish a message, and wait until most has arrived; give up one that does not arrive."""
        begin, self._pacemaker = time.monotonic(), min
        # all of a size, as the pace compares their times
        size = -(-len(data) // -(-len(data) // self._size))
        for place in range(0, len(data), size):
            part = data[place:place + size]
            with self._news:
                self._number += 1
                self._under_way.append((self._number, self._pace.sent(time.monotonic())))
            self._node.put_out(self._publisher, message.in_pieces(
                _HEADER.pack(self._identity, self._number, len(data), place) + part))
            with self._news:
                if self._news.wait_for(self._pace.may_send, LONGEST):
                    continue
                # a receiver that hangs keeps the rest of the image from no other one
                self._pacemaker = max
                self._settle(time.monotonic())
                if not self._pace.may_send():
                    # the link is cut or slower than before, or nobody listens any more
                    self._under_way.clear()
                    self._pace = Pace(QUEUED)
                    self._adapt(math.inf)
                    return
        seconds = (time.monotonic() - begin) * size / len(data)
        if len(data) > self._size or seconds > SLOW:  # larger than the image would change nothing
            self._adapt(seconds)

    def _adapt(self, seconds: float) -> None:
        """Choose the size of the next image's slices by the time that one took."""
        size = self._size * STEP if seconds < QUICK else self._size // STEP
        if QUICK <= seconds <= SLOW or not LEAST <= size <= LARGEST:
            return
        with self._news:
            # times of slices of another size say nothing about these
            self._size, self._pace = size, Pace(QUEUED)
            self._under_way.clear()

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
        """Report slices that have arrived to the pace."""
        arrived = self._pacemaker(
            (number for number, _ in self._heard_of.values()), default=0)
        while self._under_way and self._under_way[0][0] <= arrived:
            self._pace.acknowledged(self._under_way.popleft()[1], now)


@dataclasses.dataclass
class _Image:
    sender: int
    size: int
    data: bytearray


class SliceReceiver:
    """
    Receive messages in slices, and acknowledge these.

    :param whole: called with each complete serialized message.
    """

    def __init__(self, node: LazyNode, stream: str, whole: Callable[[bytes], None]) -> None:
        self._node, self._whole = node, whole
        self._feedback = node.create_publisher(
            UInt64MultiArray, f'{stream}/{ACKNOWLEDGED}', SLICES_QOS)
        self._identity = secrets.randbits(63)
        self._image: Optional[_Image] = None
        self.tap = Tap(node, UInt8MultiArray, f'{stream}/{SLICES}', SLICES_QOS, self._take,
                       adapt=False)

    def _take(self, coded: Any) -> None:
        try:
            data = message.piece(coded)
            sender, number, size, place = _HEADER.unpack_from(data)
        except (CdrError, struct.error) as error:
            self._node.complain('malformed slice', f'slice not shown: {error}')
            return
        self._node.put_out(self._feedback, UInt64MultiArray(
            data=[self._identity, sender, number]))
        if place == 0 and size <= LARGEST:
            self._image = _Image(sender, size, bytearray())
        image = self._image
        # They come in order; of an image that begins before the subscription, or of which the
        # sender gave up a slice, the rest is dropped.
        if image is None or (sender, size, place) != (image.sender, image.size, len(image.data)):
            self._image = None
            return
        image.data += data[_HEADER.size:]
        if len(image.data) >= image.size:
            self._image = None
            if len(image.data) == image.size:
                self._whole(bytes(image.data))
