# SPDX-License-Identifier: Apache-2.0
"""
Extract ORB features (Rublee et al., ICCV 2011), spread over the image, with their depths.

Depths come from a depth image, or from the right image of a stereo pair. Pyramidal Lucas-Kanade
tracks each feature along its row to the right image and back. This has subpixel accuracy, and also
works in images that a video codec has smoothed.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from typing import Any

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels
from fogros2_examples.slam.geometry import Array, Camera

#: FAST thresholds: the usual one, and one for images with too few corners.
FAINT, FAINTEST = 20, 7
SCALE, LEVELS = 1.2, 8
#: Columns and rows of cells; each cell contributes its best features.
CELLS = (10, 8)
#: Usable depths in metres; nearer and farther ones count as unknown.
NEAREST, FARTHEST = 0.2, 8.0
#: Maximum distance of a match in the right image from its row, pixels.
OFF_ROW = 1.5
#: Lucas-Kanade: window in pixels, and number of halvings of the images.
WINDOW, COARSEST = (15, 15), 4


@dataclasses.dataclass(frozen=True)
class Features:
    """
    The features of an image; N features.

    :param pixels: (N, 2).
    :param octaves: (N,), levels of the pyramid; a position is accurate to SCALE ** octave pixels.
    :param descriptors: (N, 32).
    :param depths: (N,), metres, nan for unknown.
    """

    pixels: Array
    octaves: NDArray[numpy.int32]
    descriptors: Pixels
    depths: Array

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def deep(self) -> NDArray[numpy.bool_]:
        """Which features have a depth."""
        return numpy.isfinite(self.depths)

    def chosen(self, which: NDArray[numpy.int64]) -> Features:
        """Return a selection of the features, by index."""
        return Features(self.pixels[which], self.octaves[which], self.descriptors[which],
                        self.depths[which])


class Extractor:
    """
    Extract features from images.

    :param count: maximum number of features per image.
    """

    def __init__(self, camera: Camera, count: int = 1000) -> None:
        self._camera = camera
        self._count = count
        self._strong, self._weak = (
            cv2.ORB.create(nfeatures=2 * count, scaleFactor=SCALE, nlevels=LEVELS,
                           fastThreshold=least) for least in (FAINT, FAINTEST))

    def extract(self, grey: Pixels) -> Features:
        """Return the features of an image (height, width), without depths."""
        keypoints = self._strong.detect(grey, None)
        if len(keypoints) < self._count // 2:
            keypoints = self._weak.detect(grey, None)
        chosen, descriptors = self._strong.compute(grey, self._spread(keypoints))
        if descriptors is None:
            return Features(numpy.empty((0, 2)), numpy.empty(0, numpy.int32),
                            numpy.empty((0, 32), numpy.uint8), numpy.empty(0))
        return Features(
            numpy.array([point.pt for point in chosen]),
            numpy.array([point.octave for point in chosen], numpy.int32),
            numpy.asarray(descriptors, numpy.uint8), numpy.full(len(chosen), numpy.nan))

    def _spread(self, keypoints: Sequence[cv2.KeyPoint]) -> list[cv2.KeyPoint]:
        """Return the best features of each cell, at most ``count`` in total."""
        places = numpy.array([point.pt for point in keypoints]).reshape(-1, 2)
        strength = numpy.array([point.response for point in keypoints])
        columns, rows = CELLS
        cell = (places[:, 0] * columns // self._camera.width
                + columns * (places[:, 1] * rows // self._camera.height)).astype(int)
        order = numpy.lexsort((-strength, cell))
        begins = numpy.searchsorted(cell[order], cell[order])
        rank = numpy.arange(len(order)) - begins
        # First the best of each cell, then the second best of each, and so on.
        best = order[numpy.argsort(rank, kind='stable')][:self._count]
        return [keypoints[index] for index in best]


def with_depth(features: Features, image: NDArray[numpy.generic], camera: Camera) -> Features:
    """
    Return features with depths of a depth image.

    :param image: (height, width), metres as float or millimetres as integer; 0 or nan: unknown.
    """
    columns, rows = numpy.round(features.pixels).astype(int).T
    depths = image[numpy.clip(rows, 0, camera.height - 1),
                   numpy.clip(columns, 0, camera.width - 1)].astype(float)
    if numpy.issubdtype(image.dtype, numpy.integer):
        depths /= 1000
    return dataclasses.replace(features, depths=_plausible(depths))


def with_pair(features: Features, left: Pixels, right: Pixels, camera: Camera) -> Features:
    """Return features of the left image, with depths from the right image."""
    if not len(features):
        return features
    begin = features.pixels.astype(numpy.float32)
    options: dict[str, Any] = {'winSize': WINDOW, 'criteria': (
        cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.02)}
    matched, status, _ = cv2.calcOpticalFlowPyrLK(
        left, right, begin, begin.copy(), maxLevel=COARSEST, **options)
    # For a correct match, tracking back ends within a pixel of the start.
    back, again, _ = cv2.calcOpticalFlowPyrLK(
        right, left, matched, begin.copy(), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        **options)
    shift = begin - matched
    good = (status.ravel() > 0) & (again.ravel() > 0) & (numpy.abs(shift[:, 1]) < OFF_ROW) & (
        numpy.abs(back - begin).max(1) < 0.7) & (shift[:, 0] > 0.1)
    depths = numpy.full(len(features), numpy.nan)
    depths[good] = camera.fx * camera.baseline / shift[good, 0]
    return dataclasses.replace(features, depths=_plausible(depths))


def _plausible(depths: Array) -> Array:
    with numpy.errstate(invalid='ignore'):
        return numpy.where((depths > NEAREST) & (depths < FARTHEST), depths, numpy.nan)
