# SPDX-License-Identifier: Apache-2.0
"""Code single pictures as JPEG or PNG, as ROS's ``compressed`` image transport does."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy
from numpy.typing import NDArray

from image_transport_h264.codec import Damaged
from image_transport_h264.picture import (
    BadPicture,
    Buffer,
    check_size,
    Layout,
    LAYOUTS,
    MAX_PIXELS,
    Picture,
)

Format = Literal['jpeg', 'png']
#: Arrays with 8 or 16 bits per channel.
Pixels = NDArray[Any]
PNG_LEVEL = 3
#: Markers of JPEG that stand before a frame header: APPn, COM, DQT, DHT, DAC and DRI.
_SEGMENTS = frozenset([*range(0xe0, 0xf0), 0xfe, 0xdb, 0xc4, 0xcc, 0xdd])
_TO_BGR = {'rgb24': cv2.COLOR_RGB2BGR, 'rgba': cv2.COLOR_RGBA2BGRA,
           'uyvy422': cv2.COLOR_YUV2BGR_UYVY, 'yuyv422': cv2.COLOR_YUV2BGR_YUY2}


def encode(picture: Picture, kind: Format, quality: int = 80) -> tuple[str, bytes]:
    """
    Return ``format`` and ``data`` of a ``sensor_msgs/CompressedImage``.

    :param quality: quality of JPEG, 1 to 100.
    :raises BadPicture: the fields are invalid, or the format cannot hold the encoding.
    """
    picture.check()
    layout = picture.layout
    if layout.kind == 'deep' and (kind == 'jpeg' or layout.pixel_bytes != 2):
        png = ", or 'compressed' with format='png'" if layout.pixel_bytes == 2 else ''
        raise BadPicture(f"{kind.upper()} can't hold {picture.encoding}: use the transport "
                         f"'h264', which is lossless for it{png}",
                         f'encoding {picture.encoding!r}')
    pixels = bgr(picture)
    target = 'bgr8' if pixels.ndim == 3 else picture.encoding
    return f'{picture.encoding}; {kind} compressed {target}', coded(pixels, kind, quality)


def coded(pixels: Pixels, kind: Format, quality: int) -> bytes:
    """
    Return an array of OpenCV's as JPEG or PNG; JPEG has no alpha channel.

    :raises BadPicture: OpenCV fails.
    """
    if kind == 'jpeg' and pixels.ndim == 3:
        pixels = numpy.ascontiguousarray(pixels[:, :, :3])
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == 'jpeg' else \
        [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
    whole, data = cv2.imencode('.jpg' if kind == 'jpeg' else '.png', pixels, options)
    if not whole:
        raise BadPicture(f'{kind} of {pixels.shape[1]}x{pixels.shape[0]} failed', kind)
    return bytes(data.tobytes())


def decode(form: str, data: Buffer, max_pixels: int = MAX_PIXELS) -> Picture:
    """
    Decode a JPEG or PNG image.

    :param form: ``format`` of the message; it may name the original encoding.
    :raises CodecError: the data are no image, or one of more than ``max_pixels``.
    """
    check_size(*size(bytes(data)), max_pixels)
    try:
        pixels = cv2.imdecode(numpy.frombuffer(data, numpy.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise Damaged(f'not a picture: {error.err}', 'damage') from error
    if pixels is None:
        raise Damaged(f"not a picture, format '{form}'", 'damage')
    encoding = form.partition(';')[0].strip()
    layout = LAYOUTS.get(encoding)
    if layout is None:
        encoding = {1: 'mono8', 3: 'bgr8', 4: 'bgra8'}[1 if pixels.ndim == 2 else pixels.shape[2]]
        layout = LAYOUTS[encoding]
    if layout.kind == 'yuv422':
        # OpenCV has no lossless conversion back to 4:2:2, so return colours.
        encoding, layout = 'bgr8', LAYOUTS['bgr8']
    rows = numpy.ascontiguousarray(_as(pixels, layout))
    height, width = rows.shape[:2]
    if rows.nbytes != width * height * layout.pixel_bytes:
        raise Damaged(f'{rows.dtype} pixels in a picture of {encoding}', 'damage')
    flat = rows.view(numpy.uint8).reshape(-1)
    return Picture(width, height, encoding, width * layout.pixel_bytes, flat.data)


def size(data: bytes) -> tuple[int, int]:
    """
    Return width and height of a JPEG or PNG image, from its header.

    :raises Damaged: it has no such header.
    """
    if data[:8] == b'\x89PNG\r\n\x1a\n' and data[12:16] == b'IHDR' and len(data) > 25:
        if data[24] == 16 and data[25] != 0:
            raise Damaged('16-bit colours, which no encoding has', 'damage')
        at = 8
        while at < len(data) and data[at + 4:at + 8] != b'IEND':
            at += 12 + int.from_bytes(data[at:at + 4], 'big')
        if at > len(data):
            # OpenCV would reserve the claimed length
            raise Damaged('a chunk that claims to be longer than the file', 'damage')
        return int.from_bytes(data[16:20], 'big'), int.from_bytes(data[20:24], 'big')
    at = 2 if data[:3] == b'\xff\xd8\xff' else len(data)
    # Segments of JPEG (ITU-T T.81, B.1.1.4): FF, marker, length; a frame header has the size.
    while at + 9 <= len(data) and data[at] == 0xff:
        marker = data[at + 1]
        if 0xc0 <= marker <= 0xcf and marker not in (0xc4, 0xc8, 0xcc):
            return (int.from_bytes(data[at + 7:at + 9], 'big'),
                    int.from_bytes(data[at + 5:at + 7], 'big'))
        if marker not in _SEGMENTS:
            break
        at += 2 + int.from_bytes(data[at + 2:at + 4], 'big')
    raise Damaged('neither JPEG nor PNG', 'damage')


def bgr(picture: Picture) -> Pixels:
    """
    Return a checked picture as an array of OpenCV's: grey, BGR or BGRA.

    :param picture: of another encoding than '32FC1', which OpenCV does not have.
    :raises BadPicture: a width that OpenCV does not have in this encoding.
    """
    layout = picture.layout
    if layout.kind == 'yuv422' and picture.width % 2:
        raise BadPicture(f"{picture.encoding} of an odd width: use the transport 'h264'", 'size')
    rows = numpy.ascontiguousarray(picture.rows())
    if layout.kind == 'deep':
        values = rows.view('>u2' if picture.is_bigendian else '<u2')
        return values.astype(numpy.uint16)
    if layout.kind == 'grey':
        return rows
    pixels = rows.reshape(picture.height, picture.width, layout.pixel_bytes)
    code = _TO_BGR.get(layout.av_format)
    return pixels if code is None else cv2.cvtColor(pixels, code)


def _as(pixels: Pixels, layout: Layout) -> Pixels:
    """Convert OpenCV's pixels to the layout; JPEG lost the alpha channel, so make it opaque."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if layout.kind in ('grey', 'deep'):
        return pixels if channels == 1 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    if channels == 1:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    code = {('rgb24', 3): cv2.COLOR_BGR2RGB, ('rgb24', 1): cv2.COLOR_BGR2RGB,
            ('rgba', 3): cv2.COLOR_BGR2RGBA, ('rgba', 4): cv2.COLOR_BGRA2RGBA,
            ('bgra', 3): cv2.COLOR_BGR2BGRA}.get((layout.av_format, channels))
    return pixels if code is None else cv2.cvtColor(pixels, code)
