# SPDX-License-Identifier: Apache-2.0
"""
Keep a stream within its share of the bandwidth of its links.

A decoder announces on ``<stream>/link`` which links the stream crosses, while somebody wants its
output. The encoder then reports its claim on the topic of each link, and hears the claims of the
other streams there. All streams of a direction leave the same host, so these reports stay there.
The encoder also reports on ``<stream>/share``, for the dashboard.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
import dataclasses
import math
import time
from typing import Optional

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout

from image_transport_h264 import sharing
from image_transport_h264.lazy import every, FEEDBACK_QOS, LATCHED_QOS, LazyNode, LONGEST
from image_transport_h264.sharing import Claim, Link, LISTEN, MOST_LINKS, UNLIMITED

#: Seconds between two reports; window of the rate that a stream uses, and most messages in it.
REPORT, USED_SECONDS, MOST_SENT = 0.25, 1.0, 2000
#: Seconds by which a stream may be ahead of its share: two full pictures, one cloud at 10 Hz.
#: Minimum of a stream in bits per second while nothing is known about it.
AHEAD, FLOOR = 0.1, 200_000.0
_FIXED = ParameterDescriptor(read_only=True, dynamic_typing=True)


class Budget:
    """
    The share of one stream, for its encoder.

    :param listeners: returns the number of subscriptions of the stream.
    """

    def __init__(self, node: LazyNode, stream: str, listeners: Callable[[], int]) -> None:
        self._node, self._stream, self._listeners = node, stream, listeners
        priority = float(node.declare_parameter('priority', 1.0, _FIXED).value)
        self._priority = min(100.0, max(0.01, priority))
        #: Bits per second that the stream may use, infinite without a budget.
        self.share = math.inf
        self._warned = False
        self._need = self._free_at = 0.0
        #: floor, ceiling, latency and short, as of :meth:`sent`
        self._facts = FLOOR, UNLIMITED, 0.0, False
        self._sent: deque[tuple[float, int]] = deque(maxlen=MOST_SENT)
        self._links: dict[str, tuple[Link, Publisher]] = {}
        self._reports = node.create_publisher(Float64MultiArray, f'{stream}/share', FEEDBACK_QOS)
        self._announced: Optional[Subscription] = None
        self._listen()
        every(node, REPORT, self._report)

    # --- in the executor's thread

    def _listen(self) -> None:
        """Subscribe to announcements; the remaining decoders announce again."""
        if self._announced is not None:
            self._node.destroy_subscription(self._announced)
        for link, _ in self._links.values():
            link.used = False
        self._announced = self._node.create_subscription(
            Float64MultiArray, f'{self._stream}/link', self._join, LATCHED_QOS,
            event_callbacks=SubscriptionEventCallbacks(matched=lambda change: (
                self._listen() if change.current_count_change < 0 else None)))

    def _join(self, announcement: Float64MultiArray) -> None:
        for name, bandwidth in sharing.links_of(announcement).items():
            if name not in self._links and len(self._links) < MOST_LINKS:
                link = Link(bandwidth, time.monotonic())
                self._links[name] = link, self._node.create_publisher(
                    Float64MultiArray, name, FEEDBACK_QOS)
                self._node.create_subscription(
                    Float64MultiArray, name,
                    lambda message, link=link: link.heard(message, time.monotonic()), FEEDBACK_QOS)
                self._free_at = time.monotonic() + LISTEN
            if name in self._links:
                self._links[name][0].used = True
        self._report()

    def _report(self) -> None:
        """Compute the share, and report it."""
        if not self._listeners():
            return
        now = time.monotonic()
        floor, ceiling, latency, short = self._facts
        # a copy, because the other thread appends
        used = sum(bits for when, bits in tuple(self._sent) if when > now - USED_SECONDS)
        self._need = sharing.needed(used, self.share, self._need, ceiling, short=short)
        claim = Claim(self._priority, floor, self._need, ceiling, 0.0, latency)
        links = [each for each in self._links.values() if each[0].used]
        self.share = min((link.share(self._stream, claim, now) for link, _ in links),
                         default=math.inf)
        if self.share < floor and not self._warned:
            self._warned = True
            self._node.get_logger().warning(
                f'{self._stream} gets {self.share / 1e3:.0f} kbit/s of the bandwidth of its '
                f'machine, and needs at least {floor / 1e3:.0f} kbit/s: give the machine more '
                'bandwidth=, or fewer streams')
        claim = dataclasses.replace(claim, share=min(self.share, UNLIMITED))
        for publisher in (self._reports, *(publisher for _, publisher in links)):
            self._node.put_out(publisher, _message([self._stream], dataclasses.astuple(claim)))

    # --- in the worker's thread

    def pace(self) -> None:
        """Wait until the stream is at most AHEAD of its share."""
        time.sleep(min(LONGEST, max(0.0, self._free_at - AHEAD - time.monotonic())))

    def sent(self, size: int, floor: float, latency: float, ceiling: float = UNLIMITED,
             short: bool = False) -> None:
        """
        Record that a message of ``size`` bytes was sent, and what the stream needs.

        :param floor: minimum that is of use, in bits per second; ``ceiling`` the maximum.
        :param latency: seconds from the encoder to the decoder.
        :param short: whether the stream gives up quality because of its share.
        """
        now = time.monotonic()
        self._sent.append((now, 8 * size))
        self._free_at = max(self._free_at, now) + 8 * size / self.share
        self._facts = floor, ceiling, latency, short


class Announcement:
    """
    Announce the links that a stream crosses to its decoder, while the decoder wants the stream.

    The parameter ``links`` is ``/link=BITS_PER_SECOND,...``; a link is the name of a topic.

    :raises ValueError: the parameter has another form.
    """

    def __init__(self, node: LazyNode, stream: str) -> None:
        self._node, self._topic = node, f'{stream}/link'
        text = str(node.declare_parameter('links', '', _FIXED).value)
        parts = (part.split('=') for part in text.split(',') if part)
        self._links = {name: float(bandwidth) for name, bandwidth in parts}
        self._publisher: Optional[Publisher] = None

    def want(self, wanted: bool) -> bool:
        """Announce the links, or that the stream is not wanted any more; return ``wanted``."""
        if self._publisher is not None and not wanted:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
        elif self._publisher is None and wanted and self._links:
            self._publisher = self._node.create_publisher(
                Float64MultiArray, self._topic, LATCHED_QOS)
            self._node.put_out(self._publisher, _message(self._links, self._links.values()))
        return wanted


def _message(labels: Iterable[str], data: Iterable[float]) -> Float64MultiArray:
    dim = [MultiArrayDimension(label=label, size=1, stride=1) for label in labels]
    return Float64MultiArray(layout=MultiArrayLayout(dim=dim), data=list(map(float, data)))
