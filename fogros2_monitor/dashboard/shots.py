# SPDX-License-Identifier: Apache-2.0
"""Convert images to small JPEGs for the page; depth images get colours."""

from __future__ import annotations

from typing import Any

import cv2
import numpy
from numpy.typing import NDArray

from image_transport_h264 import stills
from image_transport_h264.picture import Picture

#: Largest width of a picture in pixels, and JPEG quality.
WIDTH, QUALITY = 640, 80

Pixels = NDArray[Any]


def jpeg(picture: Picture) -> bytes:
    """
    Return a picture as JPEG, at most ``WIDTH`` pixels wide.

    :raises BadPicture: the picture's fields contradict each other, or its encoding is unknown.
    """
    picture.check()
    pixels = _coloured(_smaller(_values(picture))) if picture.layout.kind == 'deep' else \
        _smaller(stills.bgr(picture))
    return stills.coded(pixels, 'jpeg', QUALITY)


def _smaller(pixels: Pixels) -> Pixels:
    height, width = pixels.shape[:2]
    if width <= WIDTH:
        return pixels
    smaller: Pixels = cv2.resize(
        pixels, (WIDTH, max(1, round(height * WIDTH / width))), interpolation=cv2.INTER_AREA)
    return smaller


def _values(picture: Picture) -> Pixels:
    order = '>' if picture.is_bigendian else '<'
    kind = {'32FC1': 'f4', '16SC1': 'i2'}.get(picture.encoding, 'u2')
    rows = numpy.ascontiguousarray(picture.rows())
    values = rows.view(f'{order}{kind}').astype(numpy.float32)
    # Zero and infinity mark pixels without a distance.
    return numpy.where(numpy.isfinite(values) & (values != 0), values, numpy.nan)


def _coloured(values: Pixels) -> Pixels:
    """Map values to colours from near to far; pixels without a value are black."""
    mask = numpy.isfinite(values)
    near, far = numpy.percentile(values[mask], (2, 98)) if mask.any() else (0.0, 1.0)
    scaled = numpy.clip((values - near) / max(far - near, 1e-6), 0, 1)
    colours: Pixels = cv2.applyColorMap(
        (255 * (1 - numpy.nan_to_num(scaled, nan=1.0))).astype(numpy.uint8), cv2.COLORMAP_TURBO)
    colours[~mask] = 0
    return colours
