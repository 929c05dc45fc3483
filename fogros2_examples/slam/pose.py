# SPDX-License-Identifier: Apache-2.0
"""
Compute the pose of a camera from points with known positions (PnP).

RANSAC removes outliers. Robust Gauss-Newton then uses the three measurements of each feature:
column, row, and column in the right image, which is the depth (Mur-Artal and Tardos, ORB-SLAM2,
IEEE T-RO 2017, motion-only bundle adjustment).
"""

from __future__ import annotations

import dataclasses
from typing import Optional

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.slam.features import Features, SCALE
from fogros2_examples.slam.geometry import Array, Camera, from_vectors, inverse, moved

#: Maximum reprojection error in RANSAC, pixels.
LOOSE = 4.0
#: Chi-square, 95 %, of two and of three measurements; Huber's limit is its root.
TWO, THREE = 5.99, 7.81


@dataclasses.dataclass(frozen=True)
class Solution:
    """
    A pose and the points that agree with it.

    :param pose: (4, 4), of the camera.
    :param inliers: (N,), whether a given point agrees.
    """

    pose: Array
    inliers: NDArray[numpy.bool_]

    @property
    def support(self) -> int:
        """Number of points that agree."""
        return int(self.inliers.sum())


def solve(camera: Camera, points: Array, features: Features, least: int,
          guess: Optional[Array] = None) -> Optional[Solution]:
    """
    Return the camera's pose, None if fewer than ``least`` points agree.

    :param points: (N, 3), in the world.
    :param features: the same N points in the image.
    :param guess: an approximate pose, if one is known.
    """
    if len(points) < max(6, least):
        return None
    vectors = {}
    if guess is not None:
        world = inverse(guess)
        vectors = {'rvec': cv2.Rodrigues(world[:3, :3])[0], 'tvec': world[:3, 3:].copy(),
                   'useExtrinsicGuess': True}
    cv2.setRNGSeed(1)
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points, features.pixels, camera.matrix, None, iterationsCount=200,
        reprojectionError=LOOSE, confidence=0.999, flags=cv2.SOLVEPNP_EPNP, **vectors)
    if not solved or inliers is None or len(inliers) < least:
        return None
    solution = refined(camera, points, features, inverse(from_vectors(rotation, translation)))
    return solution if solution.support >= least else None


def refined(camera: Camera, points: Array, features: Features, pose: Array) -> Solution:
    """Return the best pose near a given one; outliers get less weight, and finally none."""
    world = inverse(pose)
    deep = features.deep
    scale = camera.fx * camera.baseline
    right = features.pixels[:, 0] - scale / numpy.where(deep, features.depths, 1.0)
    weights = SCALE ** (-2.0 * features.octaves)
    limit = numpy.where(deep, THREE, TWO)
    inliers = numpy.ones(len(points), bool)
    for turn in range(10):
        seen = moved(world, points)
        ahead = seen[:, 2] > 0.05
        x, y, z = seen[:, 0], seen[:, 1], numpy.where(ahead, seen[:, 2], 1.0)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        errors = numpy.stack([u - features.pixels[:, 0], v - features.pixels[:, 1],
                              numpy.where(deep, u - scale / z - right, 0.0)], 1)
        chi = weights * (errors ** 2).sum(1)
        # First keep all points, with little weight for outliers; later remove the outliers.
        inliers = ahead & (chi < limit) if turn >= 4 else ahead
        if turn == 9 or inliers.sum() < 6:
            break
        huber = numpy.where(chi < limit, 1.0, numpy.sqrt(limit / numpy.maximum(chi, 1e-9)))
        w = weights * huber * inliers
        zero = numpy.zeros_like(z)
        by_point = numpy.stack([
            numpy.stack([camera.fx / z, zero, -camera.fx * x / z ** 2], 1),
            numpy.stack([zero, camera.fy / z, -camera.fy * y / z ** 2], 1),
            numpy.stack([camera.fx / z, zero, (scale - camera.fx * x) / z ** 2], 1)
            * deep[:, None]], 1)
        # Derivatives by a small motion of the camera's frame: rotation, then translation.
        by_turn = numpy.stack([
            numpy.stack([zero, -seen[:, 2], seen[:, 1]], 1),
            numpy.stack([seen[:, 2], zero, -seen[:, 0]], 1),
            numpy.stack([-seen[:, 1], seen[:, 0], zero], 1)], 1)
        slopes = numpy.concatenate([-by_point @ by_turn, by_point], 2)
        flat = slopes.reshape(-1, 6)
        weighted = flat * numpy.repeat(w, 3)[:, None]
        step = -numpy.linalg.lstsq(weighted.T @ flat, weighted.T @ errors.ravel(), rcond=None)[0]
        world = from_vectors(step[:3], step[3:]) @ world
        if turn >= 4 and float(numpy.abs(step).max()) < 1e-7:
            break
    return Solution(inverse(world), inliers)
