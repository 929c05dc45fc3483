# SPDX-License-Identifier: Apache-2.0
"""Scale images without a change of their proportions."""

from __future__ import annotations

import cv2
import numpy
from numpy.typing import NDArray

Pixels = NDArray[numpy.uint8]


def letterbox(pixels: Pixels, width: int, height: int) -> Pixels:
    """
    Scale an image into a size, centred between black bars where its proportions differ.

    openpi's policies and LeRobot's pi0 are trained on images of this form.

    :param pixels: array (rows, columns) or (rows, columns, channels).
    :param width: width of the result in pixels, as ``height``.
    """
    rows, columns = pixels.shape[:2]
    scale = min(width / columns, height / rows)
    columns, rows = max(1, round(scale * columns)), max(1, round(scale * rows))
    left, top = (width - columns) // 2, (height - rows) // 2
    framed = numpy.zeros((height, width, *pixels.shape[2:]), numpy.uint8)
    # OpenCV drops a single channel
    framed[top:top + rows, left:left + columns] = cv2.resize(
        pixels, (columns, rows), interpolation=cv2.INTER_AREA,
    ).reshape(rows, columns, *pixels.shape[2:])
    return framed
