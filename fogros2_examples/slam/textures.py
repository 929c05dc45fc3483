# SPDX-License-Identifier: Apache-2.0
"""Generate surfaces for the synthetic room, with detail at all scales and plain areas."""

from __future__ import annotations

from typing import Any

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels

Random = numpy.random.Generator
WORDS = ('FOG', 'ROS 2', 'SLAM', 'EXIT', 'Lab 4', 'Jazzy', '42', 'north', 'B-17', 'open')


def grain(random: Random, height: int, width: int, strength: float) -> NDArray[numpy.float32]:
    """Return noise with equally strong octaves, (height, width, 1), as offsets around 0."""
    total = numpy.zeros((height, width), numpy.float32)
    size = 1
    while size < max(height, width) / 2:
        coarse = random.normal(0, 1, (height // size + 2, width // size + 2))
        total += cv2.resize(coarse.astype(numpy.float32), (width, height),
                            interpolation=cv2.INTER_CUBIC)
        size *= 3
    return numpy.asarray(strength * total[:, :, None] / max(1e-6, float(total.std())))


def tint(random: Random) -> NDArray[numpy.float64]:
    """Return a colour of printed or painted objects, rarely a pure one."""
    return numpy.clip(random.uniform(20, 235) + random.normal(0, 22, 3), 5, 250)


def plaster(random: Random, height: int, width: int, colour: tuple[int, int, int]) -> Pixels:
    """Return a nearly plain painted wall."""
    return _made(numpy.array(colour, float) + grain(random, height, width, 5.0))


def planks(random: Random, height: int, width: int, board: int) -> Pixels:
    """Return wooden boards, ``board`` pixels wide, of random lengths."""
    image = numpy.zeros((height, width, 3))
    for top in range(0, height, board):
        left = -int(random.integers(0, 8 * board))
        while left < width:
            right = left + int(random.integers(5 * board, 12 * board))
            tone = random.uniform(0.75, 1.15)
            image[top:top + board, max(0, left):max(0, right)] = (
                tone * numpy.array([70, 110, 150]))
            cv2.line(image, (right, top), (right, top + board), (35.0, 45.0, 60.0), 1)
            left = right
        cv2.line(image, (0, top), (width, top), (35.0, 45.0, 60.0), 1)
    veins = cv2.resize(grain(random, height, max(2, width // 12), 12.0), (width, height))
    return _made(image + veins[:, :, None] + grain(random, height, width, 4.0))


def books(random: Random, height: int, width: int, shelf: int) -> Pixels:
    """Return a bookcase with shelves ``shelf`` pixels apart."""
    image = numpy.full((height, width, 3), 40.0)
    for bottom in range(shelf, height + shelf, shelf):
        left = 3
        while left < width:
            right = left + int(random.integers(max(3, shelf // 12), max(5, shelf // 4)))
            top = bottom - int(random.uniform(0.6, 0.92) * shelf)
            colour = tint(random)
            cv2.rectangle(image, (left, top), (right - 2, bottom - 5), colour.tolist(), -1)
            label = top + int(random.uniform(0.1, 0.6) * (bottom - top))
            cv2.rectangle(image, (left + 1, label), (right - 3, label + shelf // 12),
                          (255 - colour).tolist(), -1)
            left = right
        cv2.rectangle(image, (0, bottom - 4), (width, bottom), (60.0, 90.0, 120.0), -1)
    return _made(image + grain(random, height, width, 4.0))


def poster(random: Random, height: int, width: int) -> Pixels:
    """Return a picture of overlapping shapes, whose sizes follow a power law, with a word."""
    image = numpy.full((height, width, 3), 200, numpy.uint8)
    for radius in sorted(0.4 * width / random.uniform(1, 40, 90), reverse=True):
        centre = (int(random.uniform(0, width)), int(random.uniform(0, height)))
        colour = tint(random).tolist()
        if random.uniform() < 0.5:
            cv2.circle(image, centre, int(radius) + 1, colour, -1, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((centre, (2 * radius + 2, radius + 2),
                                     float(random.uniform(0, 180))))
            cv2.fillConvexPoly(image, corners.astype(numpy.int32), colour, cv2.LINE_AA)
    cv2.putText(image, str(random.choice(WORDS)), (width // 10, height - height // 8),
                cv2.FONT_HERSHEY_DUPLEX, width / 130, (20.0, 20.0, 20.0), max(1, width // 60),
                cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (30.0, 30.0, 30.0),
                  max(2, width // 40))
    return _made(image + grain(random, height, width, 3.0))


def hang(random: Random, wall: Pixels, count: int, smallest: int, largest: int) -> None:
    """Hang posters on a wall, between a tenth and nine tenths of its height."""
    height, width = wall.shape[:2]
    for place in range(count):
        w = int(random.uniform(smallest, largest))
        h = min(int(w * random.uniform(0.7, 1.4)), int(0.75 * height))
        slot = width / count
        left = int(place * slot + random.uniform(0, max(1.0, slot - w)))
        top = int(random.uniform(0.1 * height, max(0.11 * height, 0.9 * height - h)))
        w = min(w, width - left)
        wall[top:top + h, left:left + w] = poster(random, h, w)


def _made(image: NDArray[numpy.floating[Any]]) -> Pixels:
    # No lens is sharper than its sensor.
    soft = cv2.GaussianBlur(numpy.clip(image, 0, 255), (0, 0), 0.7)
    return numpy.asarray(soft, numpy.uint8)
