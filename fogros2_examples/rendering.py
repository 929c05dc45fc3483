# SPDX-License-Identifier: Apache-2.0
"""Render pictures and depth images of triangle meshes by a z-buffer, without a graphics card."""

from __future__ import annotations

import dataclasses

import numpy
from numpy.typing import ArrayLike, NDArray

from fogros2_examples.meshes import Floats


@dataclasses.dataclass(frozen=True)
class Camera:
    """
    A pinhole camera; z is its viewing direction, x points right, y down.

    :param rotation: matrix (3, 3) whose columns are the camera's axes in the world.
    :param centre: position of the camera, m.
    :param focal: focal length in pixels.
    """

    width: int
    height: int
    focal: float
    rotation: Floats
    centre: Floats

    def seen(self, points: Floats) -> tuple[Floats, Floats]:
        """Project points (..., 3) to pixels (..., 2), with integer centres; also return depths."""
        turned = (points - self.centre) @ self.rotation
        depth = turned[..., 2]
        middle = numpy.array([(self.width - 1) / 2, (self.height - 1) / 2])
        with numpy.errstate(divide='ignore', invalid='ignore'):
            return turned[..., :2] / depth[..., None] * self.focal + middle, depth


def looking(at: ArrayLike, centre: ArrayLike, *, width: int, height: int, focal: float,
            up: ArrayLike = (0.0, 0.0, 1.0)) -> Camera:
    """Return a camera at ``centre`` that looks at a point; ``up`` points up in its picture."""
    forward = numpy.asarray(at, float) - numpy.asarray(centre, float)
    forward /= numpy.linalg.norm(forward)
    right = numpy.cross(forward, numpy.asarray(up, float))
    right /= numpy.linalg.norm(right)
    return Camera(width, height, focal,
                  numpy.column_stack([right, numpy.cross(forward, right), forward]),
                  numpy.asarray(centre, float))


def drawn(camera: Camera, corners: Floats, nearest: float = 0.01,
          ) -> tuple[NDArray[numpy.float32], NDArray[numpy.int32]]:
    """
    Render the depths and indices of triangles.

    :param corners: array (n, 3, 3), m; triangles with a corner nearer than ``nearest`` are not
        drawn.
    :return: two arrays (height, width): depths along the camera's axis in m, 0 for none, and
        indices of the visible triangles, -1 for none.
    """
    buffer = numpy.zeros((camera.height, camera.width), numpy.float64)  # 1 / depth
    index = numpy.full(buffer.shape, -1, numpy.int32)
    pixels, depths = camera.seen(corners)
    visible = numpy.asarray((depths > nearest).all(axis=1), bool)
    low = numpy.ceil(numpy.where(visible[:, None], pixels.min(axis=1), 0)).astype(int)
    high = numpy.floor(numpy.where(visible[:, None], pixels.max(axis=1), -1)).astype(int)
    low = numpy.maximum(low, 0)
    high = numpy.minimum(high, [camera.width - 1, camera.height - 1])
    for number in numpy.flatnonzero((high >= low).all(axis=1)):
        (ax, ay), (bx, by), (cx, cy) = pixels[number]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        x = numpy.arange(low[number, 0], high[number, 0] + 1)
        y = numpy.arange(low[number, 1], high[number, 1] + 1)[:, None]
        u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
        v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
        # 1 / depth is linear in the picture.
        a, b, c = 1 / depths[number]
        inverse = a + u * (b - a) + v * (c - a)
        rows, columns = slice(y[0, 0], y[-1, 0] + 1), slice(x[0], x[-1] + 1)
        front: NDArray[numpy.bool_] = numpy.asarray(
            (u >= 0) & (v >= 0) & (u + v <= 1) & (inverse > buffer[rows, columns]), bool)
        buffer[rows, columns][front] = inverse[front]
        index[rows, columns][front] = number
    with numpy.errstate(divide='ignore'):
        return numpy.where(buffer > 0, 1 / buffer, 0).astype(numpy.float32), index


def shaded(camera: Camera, corners: Floats, colours: Floats,
           background: ArrayLike = (255, 255, 255),
           ) -> tuple[NDArray[numpy.uint8], NDArray[numpy.float32]]:
    """
    Render triangles, lit from above the camera, with a thin line around each object.

    :param colours: colours of the triangles, array (n, 3) of 0 to 255.
    :return: array (height, width, 3), with the channels of ``colours``; the depths of ``drawn``.
    """
    # Four samples per pixel.
    fine = Camera(2 * camera.width, 2 * camera.height, 2 * camera.focal, camera.rotation,
                  camera.centre)
    depth, index = drawn(fine, corners)
    normals = numpy.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= numpy.maximum(numpy.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = camera.rotation @ numpy.array([-0.35, -0.55, -0.75])
    # Light the visible side.
    facing = numpy.sign(((camera.centre - corners[:, 0]) * normals).sum(axis=1))
    bright = 0.72 + 0.28 * numpy.clip(facing * (normals @ light), -0.7, 1)
    shades = numpy.concatenate([colours * bright[:, None], [background]])
    picture = shades[index]
    far = numpy.where(index >= 0, depth, depth.max() * 1.2)
    for axis in (0, 1):
        # A step in depth that no slope explains is the edge of an object.
        bend = numpy.abs(numpy.diff(1 / far, 2, axis=axis)) * numpy.take(
            far, range(1, far.shape[axis] - 1), axis=axis)
        rows = [slice(None), slice(None)]
        rows[axis] = slice(1, -1)
        picture[tuple(rows)][bend > 0.01] *= 0.55
    mean = picture.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
    return numpy.clip(mean, 0, 255).astype(numpy.uint8), depth[::2, ::2]
