# SPDX-License-Identifier: Apache-2.0
"""Describe images as ``sensor_msgs/Image`` does, without ROS: layouts and checks."""

from __future__ import annotations

import array
import dataclasses
from typing import Literal, Union

import numpy
from numpy.typing import NDArray

Buffer = Union[bytes, bytearray, memoryview, 'array.array[int]']
Pixels = NDArray[numpy.uint8]
Kind = Literal['rgb', 'grey', 'yuv422', 'deep']

#: Maximum side in pixels, larger than any camera's; a larger value means a damaged header.
LARGEST_SIDE = 16384
#: Pixels of the largest picture that a receiver decodes by default.
MAX_PIXELS = 4096 * 4096


class CodecError(ValueError):
    """
    A picture cannot be encoded, or a packet cannot be decoded.

    :param cause: a few constant words, so that a log can count causes instead of messages.
    """

    def __init__(self, message: str, cause: str) -> None:
        super().__init__(message)
        self.cause = cause


class BadPicture(CodecError):
    """An image's fields contradict each other, or its encoding is unknown."""


def check_size(width: int, height: int, max_pixels: int, pixel_bytes: float = 4) -> None:
    """
    Check before decoding that a picture fits into the receiver's memory.

    :param pixel_bytes: bytes that the decoder needs per pixel; there are 9 for each of
        ``max_pixels``: three frames of 8-bit colours.
    :raises CodecError: it does not.
    """
    if not (0 < width * height <= max_pixels and width * height * pixel_bytes <= 9 * max_pixels):
        raise CodecError(
            f'a picture of {width}x{height} takes more memory than max_pixels ({max_pixels}) '
            'allows', 'size')


@dataclasses.dataclass(frozen=True)
class Layout:
    """
    Memory layout of an encoding.

    :param kind: how pictures of this encoding are coded.
    :param av_format: FFmpeg's name of the layout.
    :param pixel_bytes: bytes per pixel.
    :param alpha: whether the last byte of a pixel is its opacity.
    """

    kind: Kind
    av_format: str
    pixel_bytes: int
    alpha: bool = False


LAYOUTS: dict[str, Layout] = {
    'rgb8': Layout('rgb', 'rgb24', 3),
    'bgr8': Layout('rgb', 'bgr24', 3),
    '8UC3': Layout('rgb', 'bgr24', 3),
    'rgba8': Layout('rgb', 'rgba', 4, alpha=True),
    'bgra8': Layout('rgb', 'bgra', 4, alpha=True),
    '8UC4': Layout('rgb', 'bgra', 4, alpha=True),
    'mono8': Layout('grey', 'gray', 1),
    '8UC1': Layout('grey', 'gray', 1),
    'yuv422': Layout('yuv422', 'uyvy422', 2),
    'uyvy': Layout('yuv422', 'uyvy422', 2),
    'yuv422_yuy2': Layout('yuv422', 'yuyv422', 2),
    'yuyv': Layout('yuv422', 'yuyv422', 2),
    'mono16': Layout('deep', 'gray16le', 2),
    '16UC1': Layout('deep', 'gray16le', 2),
    '16SC1': Layout('deep', 'gray16le', 2),
    '32FC1': Layout('deep', 'gray16le', 4),
}


@dataclasses.dataclass(frozen=True)
class Picture:
    """
    One image; the fields have the meaning of ``sensor_msgs/Image``.

    :param step: bytes from one row to the next, padding included.
    :param data: ``step * height`` bytes, never modified.
    """

    width: int
    height: int
    encoding: str
    step: int
    data: Buffer
    is_bigendian: bool = False

    @property
    def layout(self) -> Layout:
        """
        Return the layout of the encoding.

        :raises BadPicture: the encoding is unknown.
        """
        try:
            return LAYOUTS[self.encoding]
        except KeyError:
            names = ', '.join(LAYOUTS)
            raise BadPicture(f"encoding '{self.encoding}' isn't one of {names}: use the transport "
                             "'raw', which carries every encoding, or convert the images",
                             f'encoding {self.encoding!r}') from None

    @property
    def row_bytes(self) -> int:
        """Bytes of a row's pixels, without padding."""
        return self.width * self.layout.pixel_bytes

    def check(self) -> None:
        """
        Check that the fields agree.

        :raises BadPicture: an unknown encoding, no pixels, too many pixels, a step shorter than a
            row, or data of another length than ``step * height``.
        """
        row = self.row_bytes
        if self.width < 1 or self.height < 1:
            raise BadPicture(f'no pixels: {self.width}x{self.height}', 'size')
        if max(self.width, self.height) > LARGEST_SIDE:
            raise BadPicture(f'{self.width}x{self.height} is more than {LARGEST_SIDE} pixels wide '
                             'or high', 'size')
        if self.step < row:
            raise BadPicture(f'step {self.step} is less than the {row} bytes of {self.width} '
                             f'pixels of {self.encoding}', 'step')
        length = memoryview(self.data).nbytes
        if length != self.step * self.height:
            raise BadPicture(f'{length} bytes of data, where {self.height} rows of {self.step} '
                             f'are {self.step * self.height}', 'length')

    def rows(self) -> Pixels:
        """Return the pixels as an array (height, row_bytes) that shares the data."""
        flat = numpy.frombuffer(self.data, numpy.uint8, self.step * self.height)
        return flat.reshape(self.height, self.step)[:, :self.row_bytes]
