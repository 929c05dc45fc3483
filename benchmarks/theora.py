# SPDX-License-Identifier: Apache-2.0
"""
Theora for comparison: FFmpeg's program with libtheora encodes through a pipe, PyAV decodes.

This is not ROS's own plugin ``theora_image_transport``, which the paper measured and no wheel has.
``encode`` takes images on ``camera`` and publishes the packets of an Ogg stream, as ROS's
``theora`` transport does; ``decode`` takes those and publishes ``decoded``.
"""

from __future__ import annotations

import array
from collections import deque
import subprocess
import sys
import threading
from typing import Any, Optional

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image


class Pipe:
    """An FFmpeg process with a thread that reads what it says."""

    def __init__(self, words: list[str], heard: Any) -> None:
        self.process = subprocess.Popen(
            ['ffmpeg', '-v', 'error', '-probesize', '32', '-analyzeduration', '0', *words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        threading.Thread(target=heard, args=(self.process.stdout,), daemon=True).start()

    def write(self, data: bytes) -> None:
        """Hand bytes over."""
        assert self.process.stdin is not None
        self.process.stdin.write(data)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait(5)


class Encode(Node):
    """Images to packets, one a picture."""

    def __init__(self) -> None:
        super().__init__('theora_encode')
        self.pipe: Optional[Pipe] = None
        self.headers: deque[Any] = deque()
        self.publisher = self.create_publisher(CompressedImage, 'camera/stream', 8)
        self.create_subscription(Image, 'camera', self.take, 2)

    def take(self, image: Any) -> None:
        """Hand an image to FFmpeg, once somebody listens: Ogg's headers come but once."""
        if self.pipe is None:
            if not self.publisher.get_subscription_count():
                return
            self.pipe = Pipe(
                ['-f', 'rawvideo', '-pix_fmt', 'bgr24', '-s', f'{image.width}x{image.height}',
                 '-r', '30', '-i', '-', '-c:v', 'libtheora', '-q:v', '7', '-g', '64',
                 '-f', 'ogg', '-page_duration', '1', '-flush_packets', '1', '-'], self.pages)
        self.headers.append(image.header)
        self.pipe.write(image.data.tobytes())

    def pages(self, stream: Any) -> None:
        """Publish the packets of each page: Theora's three headers, then one a picture."""
        while True:
            head = read(stream, 27)
            if head is None:
                return
            lengths = read(stream, head[26])
            assert lengths is not None
            packet = b''
            for length in lengths:
                part = read(stream, length)
                assert part is not None
                packet += part
                if length < 255:
                    self.publish(packet)
                    packet = b''

    def publish(self, packet: bytes) -> None:
        """Publish a packet, under its picture's header unless it is one of Theora's."""
        message = CompressedImage(format='theora', data=array.array('B', packet))
        # an empty packet repeats the picture before
        if not packet or not packet[0] & 0x80:
            message.header = self.headers.popleft()
        self.publisher.publish(message)


class Decode(Node):
    """Packets to images."""

    def __init__(self) -> None:
        super().__init__('theora_decode')
        self.pipe: Optional[Pipe] = None
        self.setup: list[bytes] = []
        self.codec: Any = None
        self.last: Any = None
        self.publisher = self.create_publisher(Image, 'decoded', 2)
        self.create_subscription(CompressedImage, 'camera/stream', self.take, 8)

    def take(self, message: Any) -> None:
        """Decode a packet and publish its picture."""
        import av

        packet = message.data.tobytes()
        if packet and packet[0] & 0x80:
            self.setup.append(packet)
            if len(self.setup) == 3:
                self.codec = av.CodecContext.create('theora', 'r')
                # frame threads would hold a picture back
                self.codec.thread_count = 1
                # Theora's headers, each with its length, as FFmpeg keeps them
                self.codec.extradata = b''.join(
                    len(part).to_bytes(2, 'big') + part for part in self.setup)
            return
        if self.codec is None:
            return
        if packet:
            for frame in self.codec.decode(av.Packet(packet)):
                self.last = frame.to_ndarray(format='bgr24')
        if self.last is not None:
            height, width = self.last.shape[:2]
            self.publisher.publish(Image(
                header=message.header, width=width, height=height, step=3 * width,
                encoding='bgr8', data=array.array('B', self.last.tobytes())))


def read(stream: Any, size: int) -> Optional[bytes]:
    """Return exactly so many bytes, None at the end."""
    data = b''
    while len(data) < size:
        more = stream.read(size - len(data))
        if not more:
            return None
        data += more
    return data


def main() -> None:
    """Run one of the two."""
    rclpy.init()
    node: Any = Encode() if sys.argv[1] == 'encode' else Decode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node.pipe is not None:
            node.pipe.close()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
