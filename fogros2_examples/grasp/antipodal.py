# SPDX-License-Identifier: Apache-2.0
"""
Plan grasps of a parallel jaw on a surface, ranked by their quality.

The planner samples pairs of points that face each other across an object (antipodal points:
Nguyen, "The Synthesis of Stable Force-Closure Grasps", 1986). The jaws close in the plane of the
camera's axis and the line between the points. Two contacts with friction resist any force if the
line between them lies within both friction cones. The quality of a grasp is the mean margin of
this condition over errors of position, angle and friction: 0 if the grasp never holds, 1 if the
line is perpendicular to both surfaces under all errors (a robust quality, as in Mahler et al.,
"Dex-Net 2.0", RSS 2017).
"""

from __future__ import annotations

import dataclasses

import cv2
import fcl
import numpy
from numpy.typing import NDArray

from fogros2_examples.collisions import solid
from fogros2_examples.grasp.surface import CELL, NothingThere, Surface
from fogros2_examples.meshes import Floats, Mesh, turned


@dataclasses.dataclass(frozen=True)
class Gripper:
    """
    A parallel jaw; all lengths in m.

    :param opening: maximum distance of the jaws.
    :param finger: size of a finger along the line between the jaws, across it, and along the
        camera's axis.
    :param palm: size of the palm, which holds the fingers, in the same directions.
    :param reach: maximum depth of the finger tips below the top of the object.
    :param friction: coefficient of friction of the finger tips.
    """

    opening: float = 0.085
    finger: tuple[float, float, float] = (0.008, 0.014, 0.06)
    palm: tuple[float, float, float] = (0.12, 0.03, 0.03)
    reach: float = 0.02
    friction: float = 0.5


@dataclasses.dataclass(frozen=True)
class Grasp:
    """
    A grasp in the camera's frame.

    :param centre: point between the finger tips, m.
    :param angle: angle of the line between the jaws to the camera's x, rad, from -pi/2 to pi/2.
    :param width: distance of the contacts, m.
    :param quality: from 0 to 1.
    """

    centre: Floats
    angle: float
    width: float
    quality: float


#: Errors that a grasp must tolerate: standard deviations in m, rad, and of the friction.
PLACE, ANGLE, FRICTION = 0.0025, 0.08, 0.1
#: Minimum height of the finger tips above the floor, and free space outside of each jaw, m.
ABOVE, CLEAR = 0.003, 0.006
#: Minimum slope of a side that a jaw can press on.
SIDE = 1.2
_STEP = 0.001


def plan(seen: Surface, gripper: Gripper, *, samples: int = 1500, perturbed: int = 40,
         count: int = 12, seed: int = 0) -> list[Grasp]:
    """
    Return grasps, the best first; nearly equal grasps are merged.

    :param samples: pairs of points to try; the time grows with them and with ``perturbed``.
    :param perturbed: number of perturbations of each grasp.
    :param count: maximum number of grasps.
    :raises NothingThere: there is no object, or no object can be held; the text has the reason.
    """
    random = numpy.random.default_rng(seed)
    points, tips, angles = _sampled(seen, gripper, samples, random)
    first, second, held = closed(seen, gripper, points, angles, tips)
    good = held & (margin(seen, points, angles, first, second, gripper.friction) > 0)
    if not good.any():
        raise NothingThere('no two points of a thing face each other within the jaws')
    # Move the centres to the middle between the contacts.
    centres, angles, tips = points[good], angles[good], tips[good]
    middle = ((first + second) / 2)[good]
    width = (second - first)[good]
    centres = centres + middle[:, None] * _along(angles)
    quality = robust(seen, gripper, centres, angles, tips, perturbed, random)
    bumps = Obstacle(seen)
    chosen: list[Grasp] = []
    for i in numpy.argsort(-quality, kind='stable'):
        if quality[i] <= 0 or len(chosen) == count:
            break
        if any(numpy.linalg.norm(other.centre[:2] - centres[i]) < 0.015
               and abs(_turn(other.angle, angles[i])) < 0.5 for other in chosen):
            continue
        grasp = Grasp(numpy.array([*centres[i], seen.floor - tips[i]]),
                      float(_turn(angles[i], 0.0)), float(width[i]), float(quality[i]))
        if not bumps.hit(grasp, gripper):
            chosen.append(grasp)
    if not chosen:
        raise NothingThere('every grasp is in the way of something')
    return chosen


def _sampled(seen: Surface, gripper: Gripper, samples: int, random: numpy.random.Generator,
             ) -> tuple[Floats, Floats, Floats]:
    """Return jaw centres (n, 2), heights of finger tips, and angles for points on sides."""
    steep = numpy.linalg.norm(seen.slopes, axis=2)
    highest = _highest(seen.smooth)
    rows, columns = numpy.nonzero((steep > SIDE) & (highest > 2.5 * ABOVE))
    if not len(rows):
        raise NothingThere('nothing stands out from the floor')
    picked = random.integers(len(rows), size=samples)
    rows, columns = rows[picked], columns[picked]
    points = seen.origin + CELL * numpy.column_stack([columns, rows])
    # Uphill, towards the object, within the friction cone.
    up = seen.slopes[rows, columns]
    cone = numpy.arctan(gripper.friction)
    angles = numpy.arctan2(up[:, 1], up[:, 0]) + random.uniform(-cone, cone, samples)
    top = highest[rows, columns]
    tips = numpy.maximum(top - random.uniform(0.4, 1.0, samples) * numpy.minimum(
        gripper.reach, top - ABOVE), ABOVE)
    # The other side of the object is within the opening.
    ahead = random.uniform(0.15, 0.42, samples) * gripper.opening
    return points + ahead[:, None] * _along(angles), tips.astype(float), angles


def _highest(heights: NDArray[numpy.float32]) -> NDArray[numpy.float32]:
    return numpy.asarray(cv2.dilate(heights, numpy.ones((7, 7))), numpy.float32)


def _along(angles: Floats) -> Floats:
    return numpy.stack([numpy.cos(angles), numpy.sin(angles)], axis=-1)


def _turn(a: float, b: float) -> float:
    """Return the angle from one line to another, from -pi/2 to pi/2."""
    return float((a - b + numpy.pi / 2) % numpy.pi - numpy.pi / 2)


def closed(seen: Surface, gripper: Gripper, centres: Floats, angles: Floats, tips: Floats,
           ) -> tuple[Floats, Floats, NDArray[numpy.bool_]]:
    """
    Return the positions at which the closing jaws stop.

    :param centres: centres of the jaws, array (n, 2), m; ``tips`` are heights of finger tips.
    :return: the first and the second contact along the line, m from the centre, and whether both
        exist and the open jaws fit beside the object.
    """
    half = gripper.opening / 2
    ways = numpy.arange(-half, half + _STEP / 2, _STEP)
    line = centres[:, None] + ways[:, None] * _along(angles)[:, None]
    side = numpy.stack([-numpy.sin(angles), numpy.cos(angles)], axis=-1)
    breadth = gripper.finger[1] / 2
    # A finger has a breadth: an obstacle before any part of it stops it.
    touched = numpy.zeros(line.shape[:2], bool)
    for shift in (-breadth, 0.0, breadth):
        touched |= seen.at(seen.smooth, line + shift * side[:, None]) > tips[:, None]
    middle = seen.at(seen.smooth, line) > tips[:, None]
    touching = middle.any(axis=1)
    first = middle.argmax(axis=1)
    last = len(ways) - 1 - middle[:, ::-1].argmax(axis=1)
    # An obstacle outside the contacts blocks a finger on its way down or while it closes.
    index = numpy.arange(len(ways))
    outside = touched & ((index < first[:, None] - 3) | (index > last[:, None] + 3))
    free = ~outside.any(axis=1) & (first * _STEP > CLEAR / 2) & (
        (len(ways) - 1 - last) * _STEP > CLEAR / 2)
    return ways[first], ways[last], touching & free & (last > first + 2)


def margin(seen: Surface, centres: Floats, angles: Floats, first: Floats, second: Floats,
           friction: float | Floats) -> Floats:
    """
    Return the margin of the line between the contacts within both friction cones.

    1: the line is on the axes of both cones; 0: it is on the edge of a cone, or outside.
    """
    along = _along(angles)
    least = numpy.ones(len(centres))
    for contact, sign in ((first, 1.0), (second, -1.0)):
        # The edge is slightly inside the point where the side reaches the finger tip.
        slopes = _steepest(seen, centres + contact[:, None] * along, sign * along)
        # The inward normal of a surface z = h(x, y) is (h_x, h_y, -1).
        inward = (slopes * along).sum(axis=1) * sign
        across = numpy.sqrt((slopes ** 2).sum(axis=1) - inward ** 2 + 1.0)
        tangent = across / numpy.maximum(inward, 1e-9)
        least = numpy.minimum(least, 1 - tangent / numpy.maximum(friction, 1e-9))
    return numpy.maximum(least, 0)


def _steepest(seen: Surface, points: Floats, inward: Floats) -> Floats:
    """Return the steepest slope within 3 mm of each contact, which is the slope of the side."""
    ways = numpy.array([-0.003, -0.0015, 0.0, 0.0015, 0.003])
    slopes = seen.at(seen.slopes, points[:, None] + ways[:, None] * inward[:, None])
    chosen = (slopes * inward[:, None]).sum(axis=2).argmax(axis=1)
    steepest: Floats = slopes[numpy.arange(len(points)), chosen].astype(float)
    return steepest


def robust(seen: Surface, gripper: Gripper, centres: Floats, angles: Floats, tips: Floats,
           perturbed: int, random: numpy.random.Generator) -> Floats:
    """Return the qualities of grasps: the mean margins of their perturbations."""
    many = numpy.repeat(numpy.arange(len(centres)), perturbed)
    moved = centres[many] + random.normal(0, PLACE, (len(many), 2))
    turned_by = angles[many] + random.normal(0, ANGLE, len(many))
    lowered = numpy.maximum(tips[many] + random.normal(0, PLACE, len(many)), ABOVE / 2)
    friction = gripper.friction + random.normal(0, FRICTION, len(many))
    first, second, held = closed(seen, gripper, moved, turned_by, lowered)
    margins = held * margin(seen, moved, turned_by, first, second, friction)
    qualities: Floats = margins.reshape(-1, perturbed).mean(axis=1)
    return qualities


class Obstacle:
    """The surface as triangles that the gripper must not touch."""

    def __init__(self, seen: Surface) -> None:
        every = 2
        heights = seen.smooth[::every, ::every]
        rows, columns = heights.shape
        y, x = numpy.mgrid[:rows, :columns]
        vertices = numpy.column_stack([
            seen.origin[0] + x.ravel() * every * CELL, seen.origin[1] + y.ravel() * every * CELL,
            seen.floor - heights.ravel()]).astype(float)
        corner = (y * columns + x)[:-1, :-1].ravel()
        triangles = numpy.concatenate([
            numpy.column_stack([corner, corner + 1, corner + columns]),
            numpy.column_stack([corner + 1, corner + columns + 1, corner + columns])])
        self._surface = solid(Mesh(vertices, triangles.astype(numpy.int32)))

    def hit(self, grasp: Grasp, gripper: Gripper) -> bool:
        """Return whether the open gripper touches the surface at a grasp."""
        turn = turned((0, 0, 1), grasp.angle)
        between = grasp.width + 2 * CLEAR
        deep = gripper.finger[2]
        for size, x, z in (
                (gripper.finger, -(between + gripper.finger[0]) / 2, -deep / 2),
                (gripper.finger, (between + gripper.finger[0]) / 2, -deep / 2),
                (gripper.palm, 0.0, -deep - gripper.palm[2] / 2)):
            # Ignore the last millimetres: a finger tip may touch the floor.
            place = grasp.centre + turn @ numpy.array([x, 0.0, z - ABOVE / 2])
            part = fcl.CollisionObject(fcl.Box(*size), fcl.Transform(turn, place))
            if fcl.collide(part, self._surface, fcl.CollisionRequest(), fcl.CollisionResult()):
                return True
        return False

