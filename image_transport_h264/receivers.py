# SPDX-License-Identifier: Apache-2.0
"""What the decoder node does with a stream, by codec: video, single pictures, as it is."""

from __future__ import annotations

import abc
from collections.abc import Callable
import secrets
import threading
import time
from typing import Optional

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Empty, Header, UInt8MultiArray, UInt64MultiArray

from image_transport_h264 import message, stills
from image_transport_h264.annexb import Tag
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
from image_transport_h264.repair import Assembler
from image_transport_h264.worker import Worker

Publish = Callable[[Image], None]
#: A packet; its tag, if it is still to be acknowledged.
Coded = tuple[Header, bytes, Optional[Tag]]
#: Packets that may wait for the decoder; more of them means that it can't follow.
WAITING = 8
#: Waiting packets from which on one is acknowledged when it is decoded, and not when it comes.
BUSY = 3
#: Seconds after which a request for a key is repeated.
REQUEST_INTERVAL = 0.1


class Receiver(abc.ABC):
    """Hands what a stream brings to ``publish`` as images."""

    @abc.abstractmethod
    def want(self, wanted: bool) -> None:
        """Subscribe to the stream, or end it."""

    @abc.abstractmethod
    def stop(self) -> None:
        """End the thread, if there is one."""


def make_receiver(node: LazyNode, codec: str, stream: str, publish: Publish) -> Receiver:
    """
    Return the codec's receiver.

    :raises ValueError: no such codec.
    """
    if codec == 'h264':
        return VideoReceiver(node, stream, publish)
    if codec in ('jpeg', 'png'):
        return StillReceiver(node, stream, publish)
    if codec == 'raw':
        return RawReceiver(node, stream, publish)
    raise ValueError(f"codec '{codec}' is not one of h264, jpeg, png, raw")


class RawReceiver(Receiver):
    """Passes images on as they are."""

    def __init__(self, node: LazyNode, stream: str, publish: Publish) -> None:
        self._worker: Worker[Image] = Worker('pass', publish, node.fail)
        self._tap = Tap(node, Image, stream, IMAGE_QOS, self._worker.put)

    def want(self, wanted: bool) -> None:
        """Subscribe to the stream, or end it."""
        self._tap.want(wanted)

    def stop(self) -> None:
        """End the thread."""
        self._worker.stop()


class StillReceiver(Receiver):
    """Decodes JPEG and PNG."""

    def __init__(self, node: LazyNode, stream: str, publish: Publish) -> None:
        self._node, self._publish = node, publish
        self._worker: Worker[CompressedImage] = Worker('decode', self._decode, node.fail)
        self._tap = Tap(node, CompressedImage, stream, IMAGE_QOS, self._worker.put)

    def want(self, wanted: bool) -> None:
        """Subscribe to the stream, or end it."""
        self._tap.want(wanted)

    def stop(self) -> None:
        """End the thread."""
        self._worker.stop()

    def _decode(self, coded: CompressedImage) -> None:
        try:
            picture = stills.decode(coded.format, memoryview(coded.data))
        except CodecError as error:
            self._node.complain(error.cause, f'packet not shown: {error}')
            return
        self._publish(message.image(coded.header, picture))


class VideoReceiver(Receiver):
    """Decodes H.264, acknowledges each packet, asks for a key where one is needed."""

    def __init__(self, node: LazyNode, stream: str, publish: Publish) -> None:
        self._node, self._publish = node, publish
        show = node.declare_parameter('show_damage', False, ParameterDescriptor(
            description='show pictures that losses have left smears in', read_only=True)).value
        encoding = node.declare_parameter('encoding', 'bgr8', ParameterDescriptor(
            description="of images from encoders that aren't FogROS2's", read_only=True)).value
        self._decoder = Decoder(show_damage=bool(show), encoding=str(encoding))
        self._identity = secrets.randbits(63)
        self._asked = -1e9
        self._requests = node.create_publisher(Empty, f'{stream}/{KEY_REQUEST}', REQUEST_QOS)
        self._feedback = node.create_publisher(
            UInt64MultiArray, f'{stream}/{FEEDBACK}', FEEDBACK_QOS)
        self._worker: Worker[Coded] = Worker('decode', self._decode, node.fail, WAITING)
        self._assembler = Assembler()
        self._counted: Optional[Tag] = None
        self._acknowledged: Optional[Tag] = None
        self._lost = 0
        self._acknowledging = threading.Lock()
        # as deep pictures take it, which could never come whole otherwise
        self._tap = Tap(node, CompressedImage, stream, STREAM_QOS, self._whole, adapt=False)
        self._pieces = Tap(node, UInt8MultiArray, f'{stream}/{PIECES}', PIECES_QOS, self._piece,
                           adapt=False)

    def want(self, wanted: bool) -> None:
        """Subscribe to the stream, or end it."""
        self._tap.want(wanted)
        self._pieces.want(wanted)

    def stop(self) -> None:
        """End the thread."""
        self._worker.stop()

    def _whole(self, coded: CompressedImage) -> None:
        data = bytes(coded.data)
        tag = peek(data)
        if tag is not None:
            self._count(tag)
        if coded.format == 'ffv1':
            self._tap.ask_for(STREAM_QOS)
            # the sender waits for the middleware's acknowledgement
            self._worker.put((coded.header, data, None))
            return
        # what the network loses is repaired by pieces or a new key: waiting for it to come again
        # would hold up what has come
        self._tap.ask_for(best_effort(STREAM_QOS))
        self._take(coded.header, data, tag)

    def _piece(self, piece: UInt8MultiArray) -> None:
        whole = self._assembler.add(bytes(piece.data))
        if whole is not None:
            header, data = message.header_and_data(whole)
            self._take(header, data, peek(data))

    def _take(self, header: Header, data: bytes, tag: Optional[Tag]) -> None:
        # what is acknowledged at once tells of the link; if decoding is what takes long, the
        # sender has to hear of that
        late = self._worker.waiting >= BUSY
        # the other thread goes to work while this one acknowledges
        self._worker.put((header, data, tag if late else None))
        if tag is not None and not late:
            self._acknowledge(tag)

    def _acknowledge(self, tag: Tag) -> None:
        with self._acknowledging:
            if self._acknowledged == tag:
                return
            self._acknowledged = tag
            lost = self._lost
        self._node.put_out(self._feedback, UInt64MultiArray(
            data=[self._identity, tag.sequence, lost]))

    def _decode(self, coded: Coded) -> None:
        header, data, unacknowledged = coded
        if unacknowledged is not None:
            self._acknowledge(unacknowledged)
        try:
            picture = self._decoder.decode(data)
        except Missing as error:
            # a loss is the network's, and repaired in a moment
            self._node.get_logger().debug(str(error))
            self._ask()
            return
        except CodecError as error:
            self._node.complain(error.cause, f'packet not shown: {error}')
            self._ask()
            return
        # of pictures that come in a burst, after a repaired loss, the last ones are of interest
        if picture is not None and self._worker.waiting < 2:
            self._publish(message.image(header, picture))

    def _count(self, tag: Tag) -> None:
        """Count the packets that are missing between those that came whole."""
        last = self._counted
        if last is not None and tag.stream == last.stream:
            gap = (tag.sequence - last.sequence) & 0xffffffff
            if gap > 0x80000000:
                return
            self._lost += max(0, gap - 1)
        self._counted = tag

    def _ask(self) -> None:
        """Ask for a key, and again only after a while."""
        now = time.monotonic()
        if now - self._asked >= REQUEST_INTERVAL:
            self._asked = now
            self._node.put_out(self._requests, Empty())
