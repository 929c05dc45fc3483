# SPDX-License-Identifier: Apache-2.0
"""
Grasps of a parallel jaw on a surface, ranked by how surely they hold.

Pairs of points are sampled that face each other across a thing (antipodal points: Nguyen, "The
Synthesis of Stable Force-Closure Grasps", 1986). The jaws close in the plane of the camera's axis
and the line between the points. Two contacts with friction hold a thing against any force when
the line between them lies within both friction cones. How far within, on the mean over errors of
the jaws' place, of the angle and of the friction, is the grasp's quality: 0 where it never holds,
1 where the line stands upright on both sides whatever the error (a robust quality, as in Mahler
et al., "Dex-Net 2.0", RSS 2017).
"""

from __future__ import annotations

import dataclasses

import cv2
import fcl
import numpy
from numpy.typing import NDArray

from fogros2_examples.grasp.surface import CELL, NothingThere, Surface
from fogros2_examples.meshes import Floats, turned


@dataclasses.dataclass(frozen=True)
class Gripper:
    """
    A parallel jaw, all in m.

    :param opening: between the jaws at the most.
    :param finger: size of a finger along the line between the jaws, across it, along the camera's
        axis.
    :param palm: the same of what holds the fingers.
    :param reach: how deep the finger tips go below the top of what they grasp, at the most.
    :param friction: coefficient of the finger tips.
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

    :param centre: between the finger tips, m.
    :param angle: of the line between the jaws to the camera's x, rad, from -pi/2 to pi/2.
    :param width: between the contacts, m.
    :param quality: from 0 to 1.
    """

    centre: Floats
    angle: float
    width: float
    quality: float


#: Errors under which a grasp has to hold: standard deviations in m, rad, and of the friction.
PLACE, ANGLE, FRICTION = 0.0025, 0.08, 0.1
#: Lowest finger tips above the floor, and free way that jaws need on either side, m.
ABOVE, CLEAR = 0.003, 0.006
#: Slope from which on something is a side that a jaw can press on.
SIDE = 1.2
_STEP = 0.001


def plan(seen: Surface, gripper: Gripper, *, samples: int = 1500, perturbed: int = 40,
         count: int = 12, seed: int = 0) -> list[Grasp]:
    """
    Return grasps, the best first; no two are nearly alike.

    :param samples: pairs of points to look at; time grows with them and with ``perturbed``.
    :param perturbed: how many perturbations each is tried under.
    :param count: of grasps at the most.
    :raises NothingThere: nothing stands out, or nothing can be held; the text says which.
    """
    random = numpy.random.default_rng(seed)
    points, tips, angles = _sampled(seen, gripper, samples, random)
    first, second, held = closed(seen, gripper, points, angles, tips)
    good = held & (margin(seen, points, angles, first, second, gripper.friction) > 0)
    if not good.any():
        raise NothingThere('no two points of a thing face each other within the jaws')
    # between the contacts
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
    """Return middles of jaws (n, 2), heights of finger tips and angles for points on sides."""
    steep = numpy.linalg.norm(seen.slopes, axis=2)
    highest = _highest(seen.smooth)
    rows, columns = numpy.nonzero((steep > SIDE) & (highest > 2.5 * ABOVE))
    if not len(rows):
        raise NothingThere('nothing stands out from the floor')
    picked = random.integers(len(rows), size=samples)
    rows, columns = rows[picked], columns[picked]
    points = seen.origin + CELL * numpy.column_stack([columns, rows])
    # uphill, into the thing, within the friction cone
    up = seen.slopes[rows, columns]
    cone = numpy.arctan(gripper.friction)
    angles = numpy.arctan2(up[:, 1], up[:, 0]) + random.uniform(-cone, cone, samples)
    top = highest[rows, columns]
    tips = numpy.maximum(top - random.uniform(0.4, 1.0, samples) * numpy.minimum(
        gripper.reach, top - ABOVE), ABOVE)
    # the other side is somewhere within the opening
    ahead = random.uniform(0.15, 0.42, samples) * gripper.opening
    return points + ahead[:, None] * _along(angles), tips.astype(float), angles


def _highest(heights: NDArray[numpy.float32]) -> NDArray[numpy.float32]:
    return numpy.asarray(cv2.dilate(heights, numpy.ones((7, 7))), numpy.float32)


def _along(angles: Floats) -> Floats:
    return numpy.stack([numpy.cos(angles), numpy.sin(angles)], axis=-1)


def _turn(a: float, b: float) -> float:
    """Return the turn from one line to another, from -pi/2 to pi/2."""
    return float((a - b + numpy.pi / 2) % numpy.pi - numpy.pi / 2)


def closed(seen: Surface, gripper: Gripper, centres: Floats, angles: Floats, tips: Floats,
           ) -> tuple[Floats, Floats, NDArray[numpy.bool_]]:
    """
    Return where the jaws of grasps stop when they close.

    :param centres: of the jaws, array (n, 2), m; ``tips``, heights of the finger tips.
    :return: the first and the second contact along the line, m from the centre, and whether there
        are two and the open jaws went down beside the thing.
    """
    half = gripper.opening / 2
    ways = numpy.arange(-half, half + _STEP / 2, _STEP)
    line = centres[:, None] + ways[:, None] * _along(angles)[:, None]
    side = numpy.stack([-numpy.sin(angles), numpy.cos(angles)], axis=-1)
    breadth = gripper.finger[1] / 2
    # a finger is as broad as it is: what stands before any part of it stops it
    touched = numpy.zeros(line.shape[:2], bool)
    for shift in (-breadth, 0.0, breadth):
        touched |= seen.at(seen.smooth, line + shift * side[:, None]) > tips[:, None]
    middle = seen.at(seen.smooth, line) > tips[:, None]
    there = middle.any(axis=1)
    first = middle.argmax(axis=1)
    last = len(ways) - 1 - middle[:, ::-1].argmax(axis=1)
    # what is touched outside the contacts is touched by a finger that comes down or closes
    index = numpy.arange(len(ways))
    outside = touched & ((index < first[:, None] - 3) | (index > last[:, None] + 3))
    free = ~outside.any(axis=1) & (first * _STEP > CLEAR / 2) & (
        (len(ways) - 1 - last) * _STEP > CLEAR / 2)
    return ways[first], ways[last], there & free & (last > first + 2)


def margin(seen: Surface, centres: Floats, angles: Floats, first: Floats, second: Floats,
           friction: float | Floats) -> Floats:
    """
    Return how far the line between the contacts lies within both friction cones.

    1 is on the axes of both, 0 on the edge of one or outside.
    """
    along = _along(angles)
    least = numpy.ones(len(centres))
    for contact, sign in ((first, 1.0), (second, -1.0)):
        # the edge is a little inside of where the side has come up to the finger tip
        slopes = _steepest(seen, centres + contact[:, None] * along, sign * along)
        # of a surface z = h(x, y) the inward normal is (h_x, h_y, -1)
        inward = (slopes * along).sum(axis=1) * sign
        across = numpy.sqrt((slopes ** 2).sum(axis=1) - inward ** 2 + 1.0)
        tangent = across / numpy.maximum(inward, 1e-9)
        least = numpy.minimum(least, 1 - tangent / numpy.maximum(friction, 1e-9))
    return numpy.maximum(least, 0)


def _steepest(seen: Surface, points: Floats, inward: Floats) -> Floats:
    """Return the steepest slope within some millimetres about contacts: the side's own."""
    ways = numpy.array([-0.003, -0.0015, 0.0, 0.0015, 0.003])
    slopes = seen.at(seen.slopes, points[:, None] + ways[:, None] * inward[:, None])
    chosen = (slopes * inward[:, None]).sum(axis=2).argmax(axis=1)
    found: Floats = slopes[numpy.arange(len(points)), chosen].astype(float)
    return found


def robust(seen: Surface, gripper: Gripper, centres: Floats, angles: Floats, tips: Floats,
           perturbed: int, random: numpy.random.Generator) -> Floats:
    """Return the qualities of grasps: the mean margin of perturbed ones."""
    many = numpy.repeat(numpy.arange(len(centres)), perturbed)
    moved = centres[many] + random.normal(0, PLACE, (len(many), 2))
    turned_by = angles[many] + random.normal(0, ANGLE, len(many))
    lowered = numpy.maximum(tips[many] + random.normal(0, PLACE, len(many)), ABOVE / 2)
    friction = gripper.friction + random.normal(0, FRICTION, len(many))
    first, second, held = closed(seen, gripper, moved, turned_by, lowered)
    margins = held * margin(seen, moved, turned_by, first, second, friction)
    found: Floats = margins.reshape(-1, perturbed).mean(axis=1)
    return found


class Obstacle:
    """The surface as triangles, which a gripper must not touch on its way down."""

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
        model = fcl.BVHModel()
        model.beginModel(len(triangles), len(vertices))
        model.addSubModel(vertices, triangles)
        model.endModel()
        self._surface = fcl.CollisionObject(model, fcl.Transform())

    def hit(self, grasp: Grasp, gripper: Gripper) -> bool:
        """Return whether the open gripper touches anything where it grasps."""
        turn = turned((0, 0, 1), grasp.angle)
        between = grasp.width + 2 * CLEAR
        deep = gripper.finger[2]
        for size, x, z in (
                (gripper.finger, -(between + gripper.finger[0]) / 2, -deep / 2),
                (gripper.finger, (between + gripper.finger[0]) / 2, -deep / 2),
                (gripper.palm, 0.0, -deep - gripper.palm[2] / 2)):
            # not the last millimetres: a finger tip may stand on the floor
            place = grasp.centre + turn @ numpy.array([x, 0.0, z - ABOVE / 2])
            part = fcl.CollisionObject(fcl.Box(*size), fcl.Transform(turn, place))
            if fcl.collide(part, self._surface, fcl.CollisionRequest(), fcl.CollisionResult()):
                return True
        return False

