# SPDX-License-Identifier: Apache-2.0
"""Send images from the encoder node, by codec: video, single pictures, or raw images."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
import dataclasses
import threading
import time
from typing import Any, Optional

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Empty, UInt8MultiArray, UInt64MultiArray

from image_transport_h264 import message, stills
from image_transport_h264.budget import Budget
from image_transport_h264.cdr import CdrError
from image_transport_h264.codec import CodecError, Encoder
from image_transport_h264.control import Control
from image_transport_h264.lazy import (
    FEEDBACK_QOS,
    LazyNode,
    PIECES_QOS,
    REQUEST_QOS,
    STREAM_QOS,
)
from image_transport_h264.message import FEEDBACK, KEY_REQUEST, PIECES
from image_transport_h264.pacing import MOST, Pace, Sent
from image_transport_h264.rate import LEAST_BITS
from image_transport_h264.repair import pieces
from image_transport_h264.settings import Settings
from image_transport_h264.slices import SliceSender

CODECS = ('h264', 'jpeg', 'png', 'raw')
#: Bytes from which images are sent in slices: their acknowledgements come sooner than DDS's.
LARGE = 30_000


class Sender(abc.ABC):
    """Encode and publish images; ``send`` runs in the worker's thread."""

    publishers: Sequence[Publisher]
    _node: LazyNode

    def listeners(self) -> int:
        """Return the number of subscriptions of the stream."""
        return sum(map(self._node.subscribers, self.publishers))

    @abc.abstractmethod
    def send(self, image: bytes) -> None:
        """Encode and publish a serialized ``sensor_msgs/Image``."""


def make_sender(
    node: LazyNode, codec: str, stream: str, changed: Callable[[], None],
) -> Sender:
    """
    Create the sender of a codec.

    :param changed: callback for a change of the stream's subscribers.
    :raises ValueError: the codec is unknown.
    """
    if codec == 'h264':
        return VideoSender(node, stream, changed)
    if codec == 'raw':
        return PictureSender(node, Image, stream, changed)
    if codec in ('jpeg', 'png'):
        return StillSender(node, codec, stream, changed)
    raise ValueError(f"codec '{codec}' is not one of {', '.join(CODECS)}")


class PictureSender(Sender):
    """
    Publish raw images at the rate of their acknowledgements, so that none waits on the link.

    Meanwhile the node keeps the newest image, and drops the others.
    """

    def __init__(
        self, node: LazyNode, kind: Any, stream: str, changed: Callable[[], None],
    ) -> None:
        self._node = node
        self._publisher = node.offer(kind, stream, STREAM_QOS, changed)
        self.publishers = [self._publisher]
        self._slices = SliceSender(node, stream, changed)
        self._budget = Budget(node, stream, self.listeners)
        self._latency = 0.0
        self._pace = Pace()
        self._waiters = ThreadPoolExecutor(MOST, 'acknowledgement')
        self._under_way: list[Future[tuple[Sent, float, bool]]] = []

    def send(self, image: bytes) -> None:
        """Publish a serialized image, and wait until the next one may be sent."""
        self._budget.pace()
        begin, size = time.monotonic(), len(image)
        self._budget.sent(size, 8.0 * size, self._latency)
        if size >= LARGE and self._slices.replace(self._publisher):
            self._slices.send(image)
            self._latency = time.monotonic() - begin
            return
        self._settle()
        sent = self._pace.sent(time.monotonic())
        self._node.put_out(self._publisher, image)
        self._under_way.append(self._waiters.submit(self._acknowledged, sent))
        while not self._pace.may_send():
            wait(self._under_way, return_when=FIRST_COMPLETED)
            self._settle()

    def _acknowledged(self, sent: Sent) -> tuple[Sent, float, bool]:
        arrived = self._node.all_acknowledged(self._publisher)
        return sent, time.monotonic(), arrived

    def _settle(self) -> None:
        """Report images that are acknowledged or given up to the pace."""
        for future in [future for future in self._under_way if future.done()]:
            self._under_way.remove(future)
            sent, when, arrived = future.result()
            if arrived:
                self._pace.acknowledged(sent, when)
                self._latency = when - sent.when - self._pace.quickest / 2
            else:
                self._pace.expired(when)


class StillSender(PictureSender):
    """Publish JPEG or PNG images, as the C++ ``compressed`` transport does."""

    def __init__(
        self, node: LazyNode, codec: str, stream: str, changed: Callable[[], None],
    ) -> None:
        super().__init__(node, CompressedImage, stream, changed)
        self._kind: stills.Format = 'jpeg' if codec == 'jpeg' else 'png'
        node.declare_parameter('jpeg_quality', 80, ParameterDescriptor(
            integer_range=[IntegerRange(from_value=1, to_value=100, step=1)]))

    def send(self, image: bytes) -> None:
        """Encode and publish the image."""
        try:
            header, picture = message.picture(image)
            form, data = stills.encode(
                picture, self._kind, self._node.get_parameter('jpeg_quality').value)
        except (CdrError, CodecError) as error:
            self._node.complain(error.cause, f'image not sent: {error}')
            return
        super().send(message.compressed(header, form, data))


#: name, default, description
PARAMETERS: tuple[tuple[str, Any, str], ...] = (
    ('bitrate', 8_000_000, 'most bits per second that the stream takes'),
    ('quality', 25.0, "libx264's constant rate factor, 0 to 51, less is better"),
    ('preset', 'auto', "libx264's preset; 'auto' goes by the size"),
    ('gop', 300, 'most pictures from one key to the next'),
    ('max_rate', 0.0, 'most pictures per second, 0 for all'),
    ('encoder', 'auto', "'auto', 'libx264' or another of FFmpeg's H.264 encoders"),
    ('lossless', False, 'give back the identical pixels'),
    ('adapt', True, 'lower bitrate, then rate, where the link takes less'),
)


class VideoSender(Sender):
    """Publish H.264, and adapt to the links that the decoders report."""

    def __init__(self, node: LazyNode, stream: str, changed: Callable[[], None]) -> None:
        self._node = node
        self._lock = threading.Lock()
        values = {name: node.declare_parameter(
            name, default, ParameterDescriptor(description=what, dynamic_typing=True)).value
            for name, default, what in PARAMETERS}
        self._control = Control(
            _settings(values), float(values['max_rate']), _flag(values, 'adapt'))
        node.add_on_set_parameters_callback(self._set)
        self._encoder = Encoder(self._control.asked)
        self._key_wanted = False
        self._last_key = -1e9
        self._known = 0
        self._changed = changed
        self._video = node.offer(CompressedImage, stream, STREAM_QOS, self._matched)
        self.publishers = [self._video]
        self._budget = Budget(node, stream, self.listeners)
        # Also publish the packets for viewers such as rviz, where their message is installed.
        self._ffmpeg: Optional[Publisher] = None
        self._ffmpeg_packet = message.installed('ffmpeg_image_transport_msgs', 'FFMPEGPacket')
        if self._ffmpeg_packet is not None:
            # a driver with image_transport's plugin publishes <image>/ffmpeg
            self._ffmpeg = node.offer(
                self._ffmpeg_packet, f'{stream}/ffmpeg', STREAM_QOS, self._matched)
            self.publishers.append(self._ffmpeg)
        self._slices = SliceSender(node, stream, self._matched)
        self._pieces = node.create_publisher(
            UInt8MultiArray, f'{stream}/{PIECES}', PIECES_QOS)
        node.create_subscription(
            Empty, f'{stream}/{KEY_REQUEST}', self._key_requested, REQUEST_QOS)
        node.create_subscription(
            UInt64MultiArray, f'{stream}/{FEEDBACK}', self._heard, FEEDBACK_QOS)

    # --- in the executor's thread

    def _matched(self) -> None:
        listeners = self.listeners()
        if listeners > self._known:
            # A new reader needs a keyframe to start.
            with self._lock:
                self._key_wanted = True
        self._known = listeners
        self._changed()

    def _key_requested(self, _: Empty) -> None:
        with self._lock:
            # A keyframe that left less than a round trip ago already answers the request.
            if time.monotonic() - self._last_key > 1.5 * self._control.round_trip + 0.02:
                self._key_wanted = True

    def _heard(self, feedback: UInt64MultiArray) -> None:
        if len(feedback.data) != 3:
            return
        receiver, sequence, lost = feedback.data
        with self._lock:
            self._control.heard(receiver, sequence, lost, time.monotonic())

    def _set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        names = {name for name, _, _ in PARAMETERS}
        changed = {p.name: p.value for p in parameters if p.name in names}
        with self._lock:
            control = self._control
            values = {**dataclasses.asdict(control.asked), 'max_rate': control.max_rate,
                      'adapt': control.adapt, **changed}
            try:
                control.ask(_settings(values), float(values['max_rate']), _flag(values, 'adapt'))
            except (OverflowError, TypeError, ValueError) as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # --- in the worker's thread

    def send(self, image: bytes) -> None:
        """Encode and publish the image, unless the rate control skips it."""
        try:
            header, picture = message.picture(image)
        except CdrError as error:
            self._node.complain(error.cause, f'image not sent: {error}')
            return
        self._budget.pace()
        now = time.monotonic()
        with self._lock:
            self._control.share = self._budget.share
            if not self._control.due(now, picture.width * picture.height):
                return
            self._encoder.settings = self._control.settings(self._encoder.settings, now)
            key, self._key_wanted = self._key_wanted, False
        try:
            packet = self._encoder.encode(picture, key=key, seconds=now)
        except CodecError as error:
            self._node.complain(error.cause, f'image not sent: {error}')
            with self._lock:
                self._key_wanted |= key
            return
        if packet.format == 'ffv1':
            # An incomplete deep picture is useless, so the middleware repeats lost parts; the
            # wait for the acknowledgement limits the rate to the link's.
            self._budget.sent(len(packet.data), 8.0 * len(packet.data), 0.0)
            whole = message.compressed(header, packet.format, packet.data)
            self._slices.send_to_all(self._video, whole)
            return
        with self._lock:
            protects = self._control.protects(now)
        again: list[bytes] = []
        if protects:
            again = pieces(packet.tag.stream, packet.tag.sequence,
                           message.with_header(header, packet.data))
        time_sent = time.monotonic()
        size = len(packet.data) + sum(map(len, again))
        with self._lock:
            if packet.tag.key:
                self._last_key = time_sent
            self._control.sent(packet.tag.sequence, size, time_sent)
            floor = LEAST_BITS * picture.width * picture.height * self._encoder.settings.rate
            self._budget.sent(size, floor, self._control.latency, self._control.asked.bitrate)
        # Pieces first: after a loss, the packet is then complete one datagram later.
        for piece in again:
            self._node.put_out(self._pieces, message.in_pieces(piece))
        self._node.put_out(
            self._video, message.compressed(header, packet.format, packet.data))
        if self._ffmpeg is not None and self._node.subscribers(self._ffmpeg):
            self._node.put_out(self._ffmpeg, message.ffmpeg_packet(
                self._ffmpeg_packet, header, packet))


def _settings(values: dict[str, Any]) -> Settings:
    return Settings(
        bitrate=int(values['bitrate']), quality=float(values['quality']),
        preset=str(values['preset']), gop=int(values['gop']), encoder=str(values['encoder']),
        lossless=_flag(values, 'lossless'))


def _flag(values: dict[str, Any], name: str) -> bool:
    value = values[name]
    if value not in (True, False):
        raise TypeError(f'{name} {value!r} is neither true nor false')
    return bool(value)
