# SPDX-License-Identifier: Apache-2.0
"""
Theora for comparison, through FFmpeg's program: what the paper's ``theora`` transport does.

``encode`` takes images on ``camera`` and publishes pages of an Ogg stream, ``decode`` takes those
and publishes ``decoded``. Theora hands its pictures on one at a time, with the page's header.
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
from std_msgs.msg import String


class Pipe:
    """An FFmpeg process with a thread that reads what it says."""

    def __init__(self, words: list[str], heard: Any) -> None:
        self.process = subprocess.Popen(
            ['ffmpeg', '-v', 'error', '-fflags', 'nobuffer', '-flags', 'low_delay', *words],
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
    """Images to Ogg pages, one a picture."""

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
        """Publish each page."""
        while True:
            head = read(stream, 27)
            if head is None:
                return
            lengths = read(stream, head[26])
            assert lengths is not None
            body = read(stream, sum(lengths))
            assert body is not None
            message = CompressedImage(format='theora', data=array.array(
                'B', head + lengths + body))
            if body and not body[0] & 0x80 and self.headers:
                message.header = self.headers.popleft()
            self.publisher.publish(message)


class Decode(Node):
    """Ogg pages to images."""

    def __init__(self) -> None:
        super().__init__('theora_decode')
        self.headers: deque[Any] = deque()
        self.size: Optional[tuple[int, int]] = None
        self.pipe = Pipe(
            ['-probesize', '32', '-analyzeduration', '0', '-f', 'ogg', '-i', '-',
             '-f', 'image2pipe', '-c:v', 'ppm', '-flush_packets', '1', '-vsync', '0', '-'],
            self.pictures)
        self.publisher = self.create_publisher(Image, 'decoded', 2)
        self.create_subscription(CompressedImage, 'camera/stream', self.take, 8)
        self.unused = String

    def take(self, page: Any) -> None:
        """Hand a page to FFmpeg."""
        if page.header.frame_id:
            self.headers.append(page.header)
        self.pipe.write(page.data.tobytes())

    def pictures(self, stream: Any) -> None:
        """Publish each picture, which comes as PPM."""
        import numpy

        while True:
            fields = []
            while len(fields) < 4:
                word = token(stream)
                if word is None:
                    return
                fields.append(word)
            width, height = int(fields[1]), int(fields[2])
            data = read(stream, width * height * 3)
            if data is None:
                return
            if not self.headers:
                continue
            pixels = numpy.frombuffer(data, numpy.uint8).reshape(height, width, 3)[:, :, ::-1]
            self.publisher.publish(Image(
                header=self.headers.popleft(), width=width, height=height, step=3 * width,
                encoding='bgr8', data=array.array('B', pixels.tobytes())))


def read(stream: Any, size: int) -> Optional[bytes]:
    """Return exactly so many bytes, None at the end."""
    data = b''
    while len(data) < size:
        more = stream.read(size - len(data))
        if not more:
            return None
        data += more
    return data


def token(stream: Any) -> Optional[bytes]:
    """Return a word of a PPM header."""
    word = b''
    while True:
        byte = stream.read(1)
        if not byte:
            return None
        if byte.isspace():
            if word:
                return word
            continue
        word += byte


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
