# SPDX-License-Identifier: Apache-2.0
"""
Model the pinhole camera and rigid transforms.

A pose is an array (4, 4) that transforms points from the camera's frame to the world's. The camera
looks along its z, its y points down (REP 103's optical frame). Lengths are metres, image points
are pixels.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy
from numpy.typing import ArrayLike, NDArray

from fogros2_examples import meshes

Array = NDArray[numpy.float64]


@dataclasses.dataclass(frozen=True)
class Camera:
    """
    A rectified camera without distortion.

    :param baseline: distance to the right camera, metres. With a depth image, it is a virtual one
        that weighs depth against pixels, as in ORB-SLAM2 (Mur-Artal and Tardos, 2017).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float = 0.08

    @property
    def matrix(self) -> Array:
        """The matrix K, (3, 3)."""
        return numpy.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: Array) -> Array:
        """Project points (N, 3) of the camera to pixels (N, 2); z must be > 0."""
        z = points[:, 2]
        return numpy.stack([self.fx * points[:, 0] / z + self.cx,
                            self.fy * points[:, 1] / z + self.cy], 1)

    def lift(self, pixels: Array, depths: Array) -> Array:
        """Return the points (N, 3) of the camera at pixels (N, 2) and depths (N,)."""
        return numpy.stack([(pixels[:, 0] - self.cx) / self.fx * depths,
                            (pixels[:, 1] - self.cy) / self.fy * depths, depths], 1)


def inverse(pose: Array) -> Array:
    """Return the inverse of a pose."""
    back = numpy.eye(4)
    back[:3, :3] = pose[:3, :3].T
    back[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return back


def moved(pose: Array, points: Array) -> Array:
    """Transform points (N, 3) by a pose."""
    return numpy.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def from_vectors(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return the pose of a rotation vector and a translation."""
    pose = numpy.eye(4)
    pose[:3, :3] = cv2.Rodrigues(numpy.asarray(rotation, float).reshape(3, 1))[0]
    pose[:3, 3] = numpy.asarray(translation, float).ravel()
    return pose


def angle(pose: Array) -> float:
    """Return the angle of a pose's rotation, radians."""
    cosine = (numpy.trace(pose[:3, :3]) - 1) / 2
    return float(numpy.arccos(numpy.clip(cosine, -1.0, 1.0)))


def quaternion(pose: Array) -> Array:
    """Return a pose's rotation as (x, y, z, w), w >= 0."""
    q = meshes.quaternion(pose[:3, :3])
    return -q if q[3] < 0 else q


def from_quaternion(translation: Array, q: Array) -> Array:
    """
    Return the pose of a translation (3,) and a quaternion (x, y, z, w).

    :raises ValueError: the length of the quaternion is far from 1.
    """
    length = float(numpy.linalg.norm(q))
    if not 0.5 < length < 2.0:
        raise ValueError(f'a quaternion of length {length:.3g}')
    pose = numpy.eye(4)
    pose[:3, :3] = meshes.rotation(q)
    pose[:3, 3] = translation
    return pose
