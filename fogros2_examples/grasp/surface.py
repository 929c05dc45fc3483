# SPDX-License-Identifier: Apache-2.0
"""Convert a depth image to the heights of the objects below a camera, on a square grid."""

from __future__ import annotations

import dataclasses

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.meshes import Floats

#: Side of a cell of the grid, m.
CELL = 0.0015
#: Minimum number of pixels with a depth.
FEWEST = 500


_ROW = 1024


class NothingThere(ValueError):
    """A depth image shows nothing to grasp; the text has the reason."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """
    Heights above the floor along the camera's axis.

    :param heights: array (rows, columns), m; row and column grow with the camera's y and x.
    :param smooth: the heights without the sensor's noise.
    :param slopes: slopes of ``smooth`` along x and y, m per m: array (rows, columns, 2).
    :param origin: x and y of the first cell's middle in the camera's frame, m.
    :param floor: depth of the floor, m.
    """

    heights: NDArray[numpy.float32]
    smooth: NDArray[numpy.float32]
    slopes: NDArray[numpy.float32]
    origin: Floats
    floor: float

    def at(self, values: NDArray[numpy.float32], points: Floats) -> NDArray[numpy.float32]:
        """Interpolate values of the grid at points (..., 2) of the camera's frame."""
        cells = ((points - self.origin) / CELL).astype(numpy.float32)
        flat = cells.reshape(-1, 2)
        # OpenCV's limit is 32767 rows and columns.
        maps = numpy.resize(flat, (-(-len(flat) // _ROW), _ROW, 2))
        found = cv2.remap(values, maps[:, :, 0].copy(), maps[:, :, 1].copy(), cv2.INTER_LINEAR,
                          borderMode=cv2.BORDER_REPLICATE).reshape(-1, *values.shape[2:])
        return numpy.asarray(found[:len(flat)].reshape(*points.shape[:-1], *values.shape[2:]),
                             numpy.float32)


def surface(depth: NDArray[numpy.float32], focal: tuple[float, float],
            middle: tuple[float, float]) -> Surface:
    """
    Compute the surface of a depth image.

    :param depth: array (height, width), m; other than finite positive values mean unknown.
    :param focal: focal lengths of x and y in pixels; ``middle`` is the pixel on the camera's axis.
    :raises NothingThere: too few pixels have a depth, or the surface is too large.
    """
    known = numpy.isfinite(depth) & (depth > 0)
    if known.sum() < FEWEST:
        raise NothingThere(f'{int(known.sum())} of {depth.size} pixels have a depth')
    rows, columns = numpy.nonzero(known)
    z = depth[rows, columns].astype(float)
    x, y = (columns - middle[0]) / focal[0] * z, (rows - middle[1]) / focal[1] * z
    floor = _floor(z)
    low = numpy.array([x.min(), y.min()])
    shape = (int((y.max() - low[1]) / CELL) + 1, int((x.max() - low[0]) / CELL) + 1)
    if max(shape) > 4000:
        raise NothingThere(f'it shows {CELL * shape[1]:.1f} m by {CELL * shape[0]:.1f} m: '
                           'that is no bin within reach')
    heights = numpy.full(shape, -1, numpy.float32)
    # The camera sees the highest point of a cell.
    numpy.maximum.at(heights, (((y - low[1]) / CELL).astype(int),
                               ((x - low[0]) / CELL).astype(int)),
                     numpy.maximum(floor - z, 0).astype(numpy.float32))
    heights = _filled(heights)
    # A median keeps edges in place.
    smooth = cv2.GaussianBlur(cv2.medianBlur(heights, 5), (0, 0), 0.8)
    slopes = numpy.dstack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3),
                           cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)]) / (8 * CELL)
    return Surface(heights, numpy.asarray(smooth, numpy.float32),
                   numpy.asarray(slopes, numpy.float32), low + CELL / 2, floor)


def _floor(depths: Floats) -> float:
    """Return the depth of the floor: the largest depth that many pixels have."""
    counts, edges = numpy.histogram(depths, bins=numpy.arange(
        depths.min(), min(depths.max(), depths.min() + 5) + 0.008, 0.004))
    often = numpy.flatnonzero(counts >= 0.3 * counts.max())
    at = float(edges[often[-1]])
    near = depths[numpy.abs(depths - at - 0.002) < 0.008]
    return float(numpy.median(near))


def _filled(heights: NDArray[numpy.float32]) -> NDArray[numpy.float32]:
    """Fill cells without a height, with the lowest height beside them."""
    found = heights
    for _ in range(60):
        holes = found < 0
        if not holes.any():
            break
        # A hidden surface behind an edge is lower than the edge.
        beside = cv2.erode(numpy.where(holes, numpy.float32(9), found), numpy.ones((3, 3)))
        found = numpy.where(holes & (beside < 9), beside, found)
    return numpy.maximum(found, 0).astype(numpy.float32)
