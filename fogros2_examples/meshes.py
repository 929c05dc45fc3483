# SPDX-License-Identifier: Apache-2.0
"""Build triangle meshes from simple solids, and move them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import math

import numpy
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[numpy.float64]


@dataclasses.dataclass(frozen=True)
class Mesh:
    """
    Triangles; seen from outside, the corners of each are in counter-clockwise order.

    :param vertices: array (n, 3), m.
    :param triangles: array (m, 3) of indices into ``vertices``.
    """

    vertices: Floats
    triangles: NDArray[numpy.int32]

    @property
    def corners(self) -> Floats:
        """The corners of the triangles, array (m, 3, 3)."""
        corners: Floats = self.vertices[self.triangles]
        return corners

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> Mesh:
        """Return the mesh rotated by a matrix (3, 3), then translated."""
        return Mesh(self.vertices @ numpy.asarray(rotation).T + numpy.asarray(translation),
                    self.triangles)


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """Join meshes to one; overlapping surfaces stay."""
    vertices, triangles, count = [numpy.empty((0, 3))], [numpy.empty((0, 3), numpy.int32)], 0
    for mesh in meshes:
        vertices.append(mesh.vertices)
        triangles.append(mesh.triangles + count)
        count += len(mesh.vertices)
    return Mesh(numpy.concatenate(vertices),
                numpy.concatenate(triangles).astype(numpy.int32))


def box(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """Return a box between two corners."""
    vertices = numpy.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)]
                            for i in range(8)], float)
    return Mesh(vertices, numpy.array([
        (0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4),
        (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)], numpy.int32))


def lathe(profile: Sequence[tuple[float, float]], sides: int = 24) -> Mesh:
    """
    Return a solid of revolution about z, closed at both ends.

    :param profile: pairs (radius, z), by increasing z.
    """
    angles = numpy.arange(sides) * 2 * math.pi / sides
    rings = [numpy.column_stack([radius * numpy.cos(angles), radius * numpy.sin(angles),
                                 numpy.full(sides, z)]) for radius, z in profile]
    ends = numpy.array([[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]])
    first, last = len(rings) * sides, len(rings) * sides + 1
    triangles = []
    for i in range(sides):
        j = (i + 1) % sides
        triangles += [(first, j, i), (last, last - 1 - sides + i, last - 1 - sides + j)]
        for ring in range(0, first - sides, sides):
            triangles += [(ring + i, ring + j, ring + sides + i),
                          (ring + j, ring + sides + j, ring + sides + i)]
    return Mesh(numpy.concatenate([*rings, ends]), numpy.array(triangles, numpy.int32))


def cylinder(radius: float, height: float, sides: int = 24) -> Mesh:
    """Return a cylinder about z with its centre in the origin."""
    return lathe([(radius, -height / 2), (radius, height / 2)], sides)


def sphere(radius: float, sides: int = 24) -> Mesh:
    """Return a sphere with its centre in the origin."""
    angles = [math.pi * (i / (sides // 2) - 0.5) for i in range(1, sides // 2)]
    return lathe([(1e-6, -radius),
                  *((radius * math.cos(a), radius * math.sin(a)) for a in angles),
                  (1e-6, radius)], sides)


def rotation(quaternion: ArrayLike) -> Floats:
    """Return the matrix (3, 3) of a quaternion x, y, z, w of any length except 0."""
    given = numpy.asarray(quaternion, float)
    x, y, z, w = given / numpy.linalg.norm(given)
    return numpy.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def quaternion(matrix: Floats) -> Floats:
    """Return the quaternion x, y, z, w of a rotation (3, 3) (Shepperd, 1978)."""
    m = matrix
    squares = numpy.array([1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2],
                           1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + m[0, 0] + m[1, 1] + m[2, 2]])
    rows = numpy.array([
        [squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
        [m[0, 1] + m[1, 0], squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[2], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]]])
    row = rows[int(numpy.argmax(squares))]
    quaternion: Floats = row / numpy.linalg.norm(row)
    return quaternion


def turned(axis: Sequence[float], angle: float) -> Floats:
    """Return the matrix of a rotation by ``angle`` rad about an axis."""
    unit = numpy.asarray(axis, float) / numpy.linalg.norm(axis)
    return rotation([*(math.sin(angle / 2) * unit), math.cos(angle / 2)])
