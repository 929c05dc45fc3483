# SPDX-License-Identifier: Apache-2.0
"""Which features are the same: by descriptor, and by place where one is known."""

from __future__ import annotations

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.slam.geometry import Array

Pixels = NDArray[numpy.uint8]
Indices = NDArray[numpy.int64]
#: Bits of 256 in which two descriptors of one thing may differ.
ALIKE = 64
#: The best must be so much better than the second best.
RATIO = 0.8
#: Ones in a number; NumPy counts them itself from 2.0 on, Ubuntu 24.04 has 1.26.
_ONES = numpy.array([bin(number).count('1') for number in range(1 << 16)], numpy.uint8)


def match(one: Pixels, two: Pixels) -> tuple[Indices, Indices]:
    """
    Return pairs as two arrays of indices, each index at most once.

    :param one: descriptors (N, 32); ``two`` (M, 32).
    """
    if not len(one) or len(two) < 2:
        return _chosen(*numpy.empty((3, 0), int))
    found = numpy.array([(best.queryIdx, best.trainIdx, best.distance) for best, second
                         in cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(one, two, 2)
                         if best.distance < RATIO * second.distance]).reshape(-1, 3).astype(int)
    return _chosen(*found.T)


def match_near(one: Pixels, places: Array, two: Pixels, others: Array,
               radius: float) -> tuple[Indices, Indices]:
    """
    Return pairs as ``match`` does, of those that are near each other in the image.

    :param places: pixels (N, 2) of the first ones; ``others`` (M, 2) of the second.
    """
    order = numpy.argsort(others[:, 0])
    columns = others[order, 0]
    begin = numpy.searchsorted(columns, places[:, 0] - radius)
    count = numpy.searchsorted(columns, places[:, 0] + radius) - begin
    # each of one with each of two whose column is near
    first = numpy.repeat(numpy.arange(len(places)), count)
    offset = numpy.arange(len(first)) - numpy.repeat(numpy.cumsum(count) - count, count)
    second = order[begin[first] + offset]
    here = numpy.abs(places[first, 1] - others[second, 1]) < radius
    first, second = first[here], second[here]
    differing = one.view(numpy.uint16)[first] ^ two.view(numpy.uint16)[second]
    distance = _ONES[differing].sum(1, dtype=int)
    ranked = numpy.lexsort((distance, first))
    first, second, distance = first[ranked], second[ranked], distance[ranked]
    best = numpy.flatnonzero(numpy.diff(first, prepend=-1))
    # the next in rank, if it is of the same one
    rival = numpy.where(numpy.append(first, -1)[best + 1] == first[best],
                        numpy.append(distance, 0)[best + 1], 256)
    best = best[distance[best] < RATIO * rival]
    return _chosen(first[best], second[best], distance[best])


def _chosen(one: Indices, two: Indices, distance: Indices) -> tuple[Indices, Indices]:
    """Return the alike, and of those that chose one and the same, the nearest."""
    order = numpy.argsort(distance, kind='stable')
    order = order[distance[order] <= ALIKE]
    _, first = numpy.unique(two[order], return_index=True)
    return one[order[first]], two[order[first]]
