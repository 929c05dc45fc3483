# SPDX-License-Identifier: Apache-2.0
"""Code single pictures as JPEG or PNG, as ROS's ``compressed`` image transport does."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy
from numpy.typing import NDArray

from image_transport_h264.codec import Damaged
from image_transport_h264.picture import BadPicture, Buffer, Layout, LAYOUTS, Picture

Format = Literal['jpeg', 'png']
#: Arrays with 8 or 16 bits per channel.
Pixels = NDArray[Any]
PNG_LEVEL = 3
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
    pixels = _pixels(picture, layout)
    if kind == 'jpeg' and pixels.dtype != numpy.uint8:
        raise BadPicture(f"JPEG can't hold {picture.encoding}", f'encoding {picture.encoding!r}')
    if layout.av_format in _TO_BGR:
        pixels = cv2.cvtColor(pixels, _TO_BGR[layout.av_format])
    if kind == 'jpeg':
        if layout.alpha:
            pixels = numpy.ascontiguousarray(pixels[:, :, :3])
        options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    else:
        options = [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
    whole, data = cv2.imencode('.jpg' if kind == 'jpeg' else '.png', pixels, options)
    if not whole:
        raise BadPicture(f'{kind} of {picture.width}x{picture.height} failed', kind)
    target = 'bgr8' if pixels.ndim == 3 else picture.encoding
    return f'{picture.encoding}; {kind} compressed {target}', data.tobytes()


def decode(form: str, data: Buffer) -> Picture:
    """
    Decode a JPEG or PNG image.

    :param form: ``format`` of the message; it may name the original encoding.
    :raises Damaged: the data are no image.
    """
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
    flat = rows.view(numpy.uint8).reshape(-1)
    return Picture(width, height, encoding, width * layout.pixel_bytes, flat.data)


def _pixels(picture: Picture, layout: Layout) -> Pixels:
    rows = numpy.ascontiguousarray(picture.rows())
    if layout.kind == 'deep':
        if layout.pixel_bytes != 2:
            raise BadPicture(f"PNG can't hold {picture.encoding}",
                             f'encoding {picture.encoding!r}')
        values = rows.view('>u2' if picture.is_bigendian else '<u2')
        return values.astype(numpy.uint16)
    if layout.kind == 'grey':
        return rows
    return rows.reshape(picture.height, picture.width, layout.pixel_bytes)


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
