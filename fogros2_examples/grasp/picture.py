# SPDX-License-Identifier: Apache-2.0
"""Draw grasps with their qualities into the depth image."""

from __future__ import annotations

from collections.abc import Sequence
import math

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.grasp.antipodal import Grasp, Gripper


def picture(depth: NDArray[numpy.float32], grasps: Sequence[Grasp], focal: float, title: str,
            most: int = 5) -> NDArray[numpy.uint8]:
    """
    Return a depth image with the best grasps drawn into it.

    :param depth: array (height, width), m; the camera's axis is in its middle.
    :param grasps: ranked grasps; the first ``most`` are drawn, the best one thicker.
    :return: array (height, width, 3) of BGR.
    """
    known = depth > 0
    low, high = numpy.percentile(depth[known], (0.5, 99.5)) if known.any() else (0.0, 1.0)
    near = numpy.clip((high - depth) / max(high - low, 1e-6), 0, 1)
    grey = numpy.where(known, 70 + 185 * near, 40).astype(numpy.uint8)
    image = numpy.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), numpy.uint8)
    middle = numpy.array([(depth.shape[1] - 1) / 2, (depth.shape[0] - 1) / 2])
    for rank, grasp in reversed(list(enumerate(grasps[:most]))):
        scale = focal / grasp.centre[2]
        at = grasp.centre[:2] * scale + middle
        along = numpy.array([math.cos(grasp.angle), math.sin(grasp.angle)])
        across = numpy.array([-along[1], along[0]])
        shade = min(1.0, max(0.0, (grasp.quality - 0.4) / 0.4))
        colour = (50.0, 90 + 150 * min(1.0, 2 * shade), 60 + 195 * min(1.0, 2 - 2 * shade))
        thick = 3 if rank == 0 else 1
        half = grasp.width / 2 * scale
        bar = Gripper.finger[1] / 2 * scale
        for sign in (-1, 1):
            jaw = at + sign * half * along
            _line(image, jaw - bar * across, jaw + bar * across, colour, thick + 2)
            _line(image, jaw, jaw + sign * 0.012 * scale * along, colour, thick)
        _line(image, at - half * along, at + half * along, colour, 1)
        # Place the text beside the right jaw, where no line is.
        right = along if along[0] >= 0 else -along
        _words(image, f'{grasp.quality:.2f}',
               at + (half + 0.013 * scale) * right + numpy.array([3, 5]), colour,
               0.8 if rank == 0 else 0.55)
    _words(image, title, numpy.array([12, depth.shape[0] - 14]), (255, 255, 255), 0.6)
    return image


def beside(pictures: Sequence[NDArray[numpy.uint8]], columns: int = 5) -> NDArray[numpy.uint8]:
    """Return pictures of one size in rows of up to ``columns``, at 75 % of their size."""
    small = [numpy.asarray(cv2.resize(one, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA),
                           numpy.uint8) for one in pictures]
    columns = min(columns, len(small))
    for one in small:
        one[[0, -1]] = one[:, [0, -1]] = 255
    empty = numpy.full_like(small[0], 255)
    small += [empty] * (-len(small) % columns)
    return numpy.concatenate([
        numpy.concatenate(small[i:i + columns], axis=1) for i in range(0, len(small), columns)])


def _line(image: NDArray[numpy.uint8], begin: NDArray[numpy.float64],
          end: NDArray[numpy.float64], colour: tuple[float, float, float], thick: int) -> None:
    a, b = (tuple(numpy.rint(16 * point).astype(int).tolist()) for point in (begin, end))
    cv2.line(image, a, b, (0, 0, 0), thick + 2, cv2.LINE_AA, 4)
    cv2.line(image, a, b, colour, thick, cv2.LINE_AA, 4)


def _words(image: NDArray[numpy.uint8], text: str, at: NDArray[numpy.float64],
           colour: tuple[float, float, float], size: float) -> None:
    place = (int(at[0]), int(at[1]))
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 4, cv2.LINE_AA)
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour,
                2 if size > 0.6 else 1, cv2.LINE_AA)
