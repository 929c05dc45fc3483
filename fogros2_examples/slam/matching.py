# SPDX-License-Identifier: Apache-2.0
"""Match features by their descriptors, and by their positions if these are known."""

from __future__ import annotations

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels
from fogros2_examples.slam.geometry import Array

Indices = NDArray[numpy.int64]
#: Maximum number of different bits (of 256) in the descriptors of a match.
ALIKE = 64
#: Maximum ratio of the best distance to the second best one.
RATIO = 0.8
#: Number of ones in a number; NumPy has this from 2.0 on, but Ubuntu 24.04 has 1.26.
_ONES = numpy.array([bin(number).count('1') for number in range(1 << 16)], numpy.uint8)


def match(one: Pixels, two: Pixels) -> tuple[Indices, Indices]:
    """
    Match descriptors; return pairs as two arrays of indices, each index at most once.

    :param one: descriptors (N, 32); ``two`` (M, 32).
    """
    if not len(one) or len(two) < 2:
        return _chosen(*numpy.empty((3, 0), int))
    matches = numpy.array([(best.queryIdx, best.trainIdx, best.distance) for best, second
                            in cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(one, two, 2)
                            if best.distance < RATIO * second.distance]).reshape(-1, 3).astype(int)
    return _chosen(*matches.T)


def match_near(one: Pixels, places: Array, two: Pixels, others: Array,
               radius: float) -> tuple[Indices, Indices]:
    """
    Match descriptors of features that are near each other in the image; see ``match``.

    :param places: pixels (N, 2) of the first features; ``others`` (M, 2) of the second ones.
    :param radius: maximum distance in pixels, along rows and columns.
    """
    order = numpy.argsort(others[:, 0])
    columns = others[order, 0]
    begin = numpy.searchsorted(columns, places[:, 0] - radius)
    count = numpy.searchsorted(columns, places[:, 0] + radius) - begin
    # All pairs with a near column.
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
    # The second best candidate of the same feature, if there is one.
    rival = numpy.where(numpy.append(first, -1)[best + 1] == first[best],
                        numpy.append(distance, 0)[best + 1], 256)
    best = best[distance[best] < RATIO * rival]
    return _chosen(first[best], second[best], distance[best])


def _chosen(one: Indices, two: Indices, distance: Indices) -> tuple[Indices, Indices]:
    """Keep pairs with similar descriptors; of pairs with one target, keep the best one."""
    order = numpy.argsort(distance, kind='stable')
    order = order[distance[order] <= ALIKE]
    _, first = numpy.unique(two[order], return_index=True)
    return one[order[first]], two[order[first]]
