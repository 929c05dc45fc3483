# SPDX-License-Identifier: Apache-2.0
"""Receive a stream in the decoder node, by codec: video, single pictures, or raw images."""

from __future__ import annotations

from collections.abc import Callable
import functools
import secrets
import time
from typing import Any, Optional

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Empty, UInt8MultiArray, UInt64MultiArray

from image_transport_h264 import message, stills
from image_transport_h264.annexb import Tag
from image_transport_h264.cdr import CdrError, Header
from image_transport_h264.codec import CodecError, Decoder, Missing, peek
from image_transport_h264.lazy import (
    best_effort,
    FEEDBACK_QOS,
    IMAGE_QOS,
    LazyNode,
    PIECES_QOS,
    REQUEST_QOS,
    STREAM_QOS,
    Tap,
)
from image_transport_h264.message import FEEDBACK, KEY_REQUEST, PIECES
from image_transport_h264.picture import MAX_PIXELS
from image_transport_h264.repair import Assembler
from image_transport_h264.slices import SliceReceiver

Publish = Callable[[bytes], None]
#: A packet, with its tag if it is to be acknowledged when it is decoded.
Coded = tuple[Header, bytes, Optional[Tag]]
#: Maximum number of packets that wait for the decoder; with more, the decoder is too slow.
WAITING = 8
#: From this number of waiting packets on, packets are acknowledged when they are decoded.
BUSY = 3
#: Seconds after which a request for a keyframe is repeated.
REQUEST_INTERVAL = 0.1


class Receiver:
    """
    Receive a stream, in the executor's thread and in a worker thread.

    :param taps: the subscriptions.
    """

    def __init__(self, *taps: Tap) -> None:
        self._taps = taps

    def want(self, wanted: bool) -> None:
        """Subscribe to the stream, or unsubscribe."""
        for tap in self._taps:
            tap.want(wanted)


def make_receiver(node: LazyNode, codec: str, stream: str, publish: Publish) -> Receiver:
    """
    Create the receiver of a codec, which passes serialized images to ``publish``.

    :raises ValueError: the codec is unknown.
    """
    if codec == 'h264':
        return VideoReceiver(node, stream, publish)
    kind: Any = Image
    work: Callable[[bytes], None] = publish
    if codec in ('jpeg', 'png'):
        kind = CompressedImage
        work = functools.partial(_decode_still, node, publish, _max_pixels(node))
    elif codec != 'raw':
        raise ValueError(f"codec '{codec}' is not one of h264, jpeg, png, raw")
    put = node.start_worker('decode', work).put
    return Receiver(Tap(node, kind, stream, IMAGE_QOS, put), SliceReceiver(node, stream, put).tap)


def _max_pixels(node: LazyNode) -> int:
    return int(node.declare_parameter('max_pixels', MAX_PIXELS, ParameterDescriptor(
        description='larger images are not decoded', read_only=True)).value)


def _decode_still(
    node: LazyNode, publish: Publish, max_pixels: int, coded: bytes,
) -> None:
    """Decode a JPEG or PNG image."""
    try:
        header, form, data = message.coded(coded)
        picture = stills.decode(form, data, max_pixels)
    except (CdrError, CodecError) as error:
        node.complain(error.cause, f'packet not shown: {error}')
        return
    publish(message.image(header, picture))


class VideoReceiver(Receiver):
    """Decode H.264, acknowledge each packet, and request keyframes when the decoder needs one."""

    def __init__(self, node: LazyNode, stream: str, publish: Publish) -> None:
        self._node, self._publish = node, publish
        encoding = node.declare_parameter('encoding', 'bgr8', ParameterDescriptor(
            description="of images from encoders that aren't FogROS2's", read_only=True)).value
        self._decoder = Decoder(encoding=str(encoding), max_pixels=_max_pixels(node))
        self._identity = secrets.randbits(63)
        self._asked = -1e9
        self._requests = node.create_publisher(Empty, f'{stream}/{KEY_REQUEST}', REQUEST_QOS)
        self._feedback = node.create_publisher(
            UInt64MultiArray, f'{stream}/{FEEDBACK}', FEEDBACK_QOS)
        self._worker = node.start_worker('decode', self._decode, WAITING)
        self._assembler = Assembler()
        self._counted: Optional[Tag] = None
        self._lost = 0
        # Reliable, because a deep picture would never arrive completely otherwise.
        self._tap = Tap(node, CompressedImage, stream, STREAM_QOS, self._whole, adapt=False)
        pieces = Tap(node, UInt8MultiArray, f'{stream}/{PIECES}', PIECES_QOS, self._piece,
                     adapt=False)
        super().__init__(self._tap, pieces, SliceReceiver(node, stream, self._whole).tap)

    def _whole(self, coded: bytes) -> None:
        try:
            header, form, view = message.coded(coded)
        except CdrError as error:
            self._node.complain(error.cause, f'packet not shown: {error}')
            return
        data = bytes(view)
        tag = peek(data)
        if tag is not None:
            self._count(tag)
        if form == 'ffv1':
            self._tap.ask_for(STREAM_QOS)
            # The sender waits for the acknowledgement of the middleware.
            self._worker.put((header, data, None))
            return
        # Pieces or a new keyframe repair losses; repetition by the middleware would delay packets
        # that have already arrived.
        self._tap.ask_for(best_effort(STREAM_QOS))
        self._take(header, data, tag)

    def _piece(self, piece: bytes) -> None:
        try:
            whole = self._assembler.add(message.piece(piece))
            if whole is None:
                return
            header, data = message.header_and_data(whole)
        except CdrError as error:
            self._node.complain(error.cause, f'packet not shown: {error}')
            return
        self._take(header, data, peek(data))

    def _take(self, header: Header, data: bytes, tag: Optional[Tag]) -> None:
        # An early acknowledgement measures the link. If decoding is the bottleneck, acknowledge
        # late, so that the sender slows down.
        late = self._worker.waiting >= BUSY
        # First start the other thread's work, then acknowledge.
        self._worker.put((header, data, tag if late else None))
        if tag is not None and not late:
            self._acknowledge(tag)

    def _acknowledge(self, tag: Tag) -> None:
        self._node.put_out(self._feedback, UInt64MultiArray(
            data=[self._identity, tag.sequence, self._lost]))

    def _decode(self, coded: Coded) -> None:
        header, data, unacknowledged = coded
        if unacknowledged is not None:
            self._acknowledge(unacknowledged)
        try:
            picture = self._decoder.decode(data)
        except Missing as error:
            # A loss in the network is ordinary, and soon repaired.
            self._node.get_logger().debug(str(error))
            self._ask()
            return
        except CodecError as error:
            self._node.complain(error.cause, f'packet not shown: {error}')
            self._ask()
            return
        # After a repaired loss, pictures come in a burst; show only the last ones.
        if picture is not None and self._worker.waiting < 2:
            self._publish(message.image(header, picture))

    def _count(self, tag: Tag) -> None:
        """Count the packets that are missing between complete packets."""
        last = self._counted
        if last is not None and tag.stream == last.stream:
            gap = (tag.sequence - last.sequence) & 0xffffffff
            if gap > 0x80000000:
                return
            self._lost += max(0, gap - 1)
        self._counted = tag

    def _ask(self) -> None:
        """Request a keyframe, at most once per interval."""
        now = time.monotonic()
        if now - self._asked >= REQUEST_INTERVAL:
            self._asked = now
            self._node.put_out(self._requests, Empty())
