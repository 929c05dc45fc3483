# SPDX-License-Identifier: Apache-2.0
"""Generate synthetic bins of objects, and the depth images of a camera above them."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import math

import fcl
import numpy
from numpy.typing import NDArray

from fogros2_examples.collisions import solid
from fogros2_examples.meshes import box, cylinder, Floats, joined, lathe, Mesh, sphere, turned
from fogros2_examples.rendering import Camera, drawn

#: Sides of the bin's floor, m; its walls are outside of the camera's view.
SIZE = (0.46, 0.34)
#: Height of the camera above the floor, m, and its focal length per pixel of its width.
HEIGHT, FOCAL = 0.7, 1.6
#: Standard deviation of the sensor's noise, m, and maximum angle of a visible surface.
NOISE, STEEPEST = 0.0005, math.radians(84)


def _dumbbell(scale: float) -> Mesh:
    ball = sphere(0.021 * scale)
    bar = cylinder(0.009 * scale, 0.07 * scale, 16)
    return joined([ball.moved(numpy.eye(3), (0, 0, -0.04 * scale)), bar,
                   ball.moved(numpy.eye(3), (0, 0, 0.04 * scale))])


def _bracket(scale: float) -> Mesh:
    return joined([box((-0.04 * scale, -0.016 * scale, 0), (0.04 * scale, 0.016 * scale, 0.014)),
                   box((0.024 * scale, -0.016 * scale, 0), (0.04 * scale, 0.016 * scale,
                                                            0.05 * scale))])


def _bottle(scale: float) -> Mesh:
    return lathe([(r * scale, z * scale) for r, z in (
        (0.018, -0.055), (0.024, -0.05), (0.024, 0.015), (0.011, 0.035), (0.011, 0.05),
        (0.013, 0.051), (0.013, 0.06))])


def _brick(scale: float) -> Mesh:
    return box((-0.045 * scale, -0.02 * scale, -0.015 * scale),
               (0.045 * scale, 0.02 * scale, 0.015 * scale))


def _can(scale: float) -> Mesh:
    return cylinder(0.026 * scale, 0.075 * scale, 32)


#: Kinds of objects in a bin.
KINDS: tuple[Callable[[float], Mesh], ...] = (
    _brick, _can, _bottle, _dumbbell, _bracket, lambda scale: sphere(0.026 * scale))


@dataclasses.dataclass(frozen=True)
class Bin:
    """
    A bin; z points up, and the origin is the middle of its floor.

    :param objects: the objects at their places.
    """

    objects: tuple[Mesh, ...]
    floor: Mesh

    @property
    def corners(self) -> Floats:
        """The corners of all triangles, with the floor's last, array (n, 3, 3)."""
        return joined([*self.objects, self.floor]).corners


def thrown(seed: int, count: int = 9) -> Bin:
    """Return a bin with objects; each object fell straight down onto the objects below it."""
    random = numpy.random.default_rng(seed)
    floor = box((-SIZE[0] / 2, -SIZE[1] / 2, -0.01), (SIZE[0] / 2, SIZE[1] / 2, 0))
    objects: list[Mesh] = []
    lying = [solid(floor)]
    for _ in range(count):
        mesh = KINDS[int(random.integers(len(KINDS)))](float(random.uniform(0.85, 1.2)))
        # Objects rest on a face more often than on an edge.
        tilt = math.pi / 2 * int(random.integers(2)) + float(random.normal(0, 0.12))
        turn = turned((0, 0, 1), float(random.uniform(0, 2 * math.pi))) @ turned((1, 0, 0), tilt)
        x, y = random.uniform(-0.5, 0.5, 2) * (numpy.array(SIZE) - 0.14)
        mesh = mesh.moved(turn, (x, y, 0))
        mesh = mesh.moved(numpy.eye(3), (0, 0, -mesh.vertices[:, 2].min()))
        height = _resting(mesh, lying)
        mesh = mesh.moved(numpy.eye(3), (0, 0, height))
        objects.append(mesh)
        lying.append(solid(mesh))
    return Bin(tuple(objects), floor)


def _resting(mesh: Mesh, lying: list[fcl.CollisionObject]) -> float:
    """Return the height above the floor at which a falling mesh stops."""
    falling = solid(mesh)

    def touches(height: float) -> bool:
        falling.setTransform(fcl.Transform(numpy.array([0.0, 0.0, height])))
        return any(fcl.collide(falling, other, fcl.CollisionRequest(), fcl.CollisionResult())
                   for other in lying)

    height = 0.3
    while height > 0.001 and not touches(height - 0.004):
        height -= 0.004
    return max(height, 0.0005)


def camera(width: int = 640, height: int = 480) -> Camera:
    """Return the camera over a bin; it looks straight down."""
    return Camera(width, height, FOCAL * width,
                  numpy.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), numpy.array([0, 0, HEIGHT]))


def depth_image(contents: Bin, eye: Camera, seed: int) -> NDArray[numpy.float32]:
    """
    Return a depth image in m, 0 for unknown.

    The camera has noise, and does not see surfaces at grazing angles.
    """
    corners = contents.corners
    depth, index = drawn(eye, corners)
    normals = numpy.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(axis=1) - eye.centre
    slant = numpy.abs((normals * middle).sum(axis=1)) / (
        numpy.linalg.norm(normals, axis=1) * numpy.linalg.norm(middle, axis=1) + 1e-12)
    seen = (index >= 0) & (slant[index] > math.cos(STEEPEST))
    noise = numpy.random.default_rng(seed).normal(0, NOISE, depth.shape)
    return numpy.where(seen, depth + noise, 0).astype(numpy.float32)
