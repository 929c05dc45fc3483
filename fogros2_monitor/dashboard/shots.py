# SPDX-License-Identifier: Apache-2.0
"""Convert images to small JPEGs for the page; depth images get colours."""

from __future__ import annotations

from typing import Any

import cv2
import numpy
from numpy.typing import NDArray

from image_transport_h264.picture import BadPicture, Layout, Picture

#: Largest width of a picture in pixels, and JPEG quality.
WIDTH, QUALITY = 640, 80
_TO_BGR = {'rgb24': cv2.COLOR_RGB2BGR, 'rgba': cv2.COLOR_RGBA2BGR, 'bgra': cv2.COLOR_BGRA2BGR,
           'uyvy422': cv2.COLOR_YUV2BGR_UYVY, 'yuyv422': cv2.COLOR_YUV2BGR_YUY2}

Pixels = NDArray[Any]


def jpeg(picture: Picture) -> bytes:
    """
    Return a picture as JPEG, at most ``WIDTH`` pixels wide.

    :raises BadPicture: the picture's fields contradict each other, or its encoding is unknown.
    """
    picture.check()
    layout = picture.layout
    rows = numpy.ascontiguousarray(picture.rows())
    if layout.kind == 'deep':
        pixels = _coloured(_smaller(_values(picture, layout, rows)))
    elif layout.kind == 'grey':
        pixels = _smaller(rows)
    else:
        pixels = rows.reshape(picture.height, picture.width, layout.pixel_bytes)
        if layout.kind == 'rgb':
            pixels = _smaller(pixels)
        if layout.av_format in _TO_BGR:
            pixels = cv2.cvtColor(pixels, _TO_BGR[layout.av_format])
        pixels = _smaller(pixels)
    whole, data = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not whole:
        raise BadPicture(f'JPEG of {picture.width}x{picture.height} failed', 'jpeg')
    return bytes(data.tobytes())


def _smaller(pixels: Pixels) -> Pixels:
    height, width = pixels.shape[:2]
    if width <= WIDTH:
        return pixels
    smaller: Pixels = cv2.resize(
        pixels, (WIDTH, max(1, round(height * WIDTH / width))), interpolation=cv2.INTER_AREA)
    return smaller


def _values(picture: Picture, layout: Layout, rows: Pixels) -> Pixels:
    order = '>' if picture.is_bigendian else '<'
    kind = {'32FC1': 'f4', '16SC1': 'i2'}.get(picture.encoding, 'u2')
    values = rows.view(f'{order}{kind}').astype(numpy.float32)
    # Zero and infinity mark pixels without a distance.
    return numpy.where(numpy.isfinite(values) & (values != 0), values, numpy.nan)


def _coloured(values: Pixels) -> Pixels:
    """Map values to colours from near to far; pixels without a value are black."""
    known = numpy.isfinite(values)
    near, far = numpy.percentile(values[known], (2, 98)) if known.any() else (0.0, 1.0)
    scaled = numpy.clip((values - near) / max(far - near, 1e-6), 0, 1)
    colours: Pixels = cv2.applyColorMap(
        (255 * (1 - numpy.nan_to_num(scaled, nan=1.0))).astype(numpy.uint8), cv2.COLORMAP_TURBO)
    colours[~known] = 0
    return colours
