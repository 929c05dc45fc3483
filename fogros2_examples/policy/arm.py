# SPDX-License-Identifier: Apache-2.0
"""Simulate a planar arm with two joints and two cameras, and the expert that a policy imitates."""

from __future__ import annotations

import cv2
import numpy
from numpy.typing import ArrayLike

from fogros2_examples.letterbox import Pixels
from fogros2_examples.meshes import Floats
from fogros2_examples.rendering import Camera, looking

JOINTS = ('shoulder', 'elbow')
#: Lengths of the two links, half of their width, and the radius of the target, m.
LINKS, HALF, RADIUS = (0.5, 0.4), 0.03, 0.06
#: Where targets are: distance from the base in m, angle in rad.
NEAR, FAR, RIGHT, LEFT = 0.35, 0.8, 0.5, 2.6
#: The expert: time constant near the goal in s, and the most that the joints turn, rad/s.
SLOWING, FASTEST = 0.25, 1.5
#: Time constant of the motors, s.
LAG = 0.03
TABLE, LINK, JOINT, TARGET = (214, 208, 200), (150, 110, 60), (70, 60, 50), (50, 60, 220)
_CIRCLE = numpy.linspace(0, 2 * numpy.pi, 24, endpoint=False)


def corners(joints: ArrayLike) -> Floats:
    """Return base, elbow and tip (3, 2) of an arm whose joints have these angles, m."""
    turns = numpy.cumsum(numpy.asarray(joints, float))
    steps = numpy.array(LINKS)[:, None] * numpy.stack([numpy.cos(turns), numpy.sin(turns)], 1)
    return numpy.concatenate([numpy.zeros((1, 2)), numpy.cumsum(steps, axis=0)])


def reaching(points: ArrayLike) -> Floats:
    """Return the angles (..., 2) with which the tip is at points (..., 2), elbow to the right."""
    x, y = numpy.moveaxis(numpy.asarray(points, float), -1, 0)
    (a, b), far = LINKS, numpy.hypot(x, y)
    elbow = numpy.arccos(numpy.clip((far ** 2 - a ** 2 - b ** 2) / (2 * a * b), -1, 1))
    shoulder = numpy.arctan2(y, x) - numpy.arctan2(
        b * numpy.sin(elbow), a + b * numpy.cos(elbow))
    return numpy.stack([shoulder, elbow], -1)


def targets(count: int, chance: numpy.random.Generator) -> Floats:
    """Return random targets (count, 2), m."""
    far, turn = chance.uniform(NEAR, FAR, count), chance.uniform(RIGHT, LEFT, count)
    return numpy.stack([far * numpy.cos(turn), far * numpy.sin(turn)], -1)


def expert(joints: Floats, target: Floats, times: Floats) -> Floats:
    """
    Return what the expert commands: angles (..., times, 2) on the way to a target.

    The joints turn with a limited speed that falls near the goal. The speed depends on the angles
    alone, so a plan that is made again on the way is the rest of the same plan.
    """
    way = reaching(target) - joints
    far = numpy.maximum(numpy.linalg.norm(way, axis=-1), 1e-9)[..., None]
    brake = SLOWING * FASTEST
    cruise = numpy.maximum(far - brake, 0) / FASTEST
    remaining = numpy.where(times < cruise, far - FASTEST * times,
                            numpy.minimum(far, brake)
                            * numpy.exp(-numpy.maximum(times - cruise, 0) / SLOWING))
    turned: Floats = joints[..., None, :] + (1 - remaining / far)[..., None] * way[..., None, :]
    return turned


def cameras(width: int, height: int) -> dict[str, Camera]:
    """Return the two cameras, one above the table and one beside it."""
    size = {'width': width, 'height': height}
    return {'top': looking((0, 0.35, 0), (0, 0.34, 2.0), focal=1.25 * width, **size),
            'side': looking((0, 0.35, 0), (1.2, -0.6, 1.1), focal=1.05 * width, **size)}


def picture(camera: Camera, joints: ArrayLike, target: ArrayLike) -> Pixels:
    """Render the arm and its target, array (height, width, 3) of BGR."""
    image = numpy.empty((camera.height, camera.width, 3), numpy.uint8)
    image[:] = TABLE

    def fill(outline: Floats, colour: tuple[int, int, int]) -> None:
        points = numpy.concatenate([outline, numpy.zeros((len(outline), 1))], axis=1)
        cv2.fillConvexPoly(image, numpy.rint(16 * camera.seen(points)[0]).astype(numpy.int32),
                           colour, cv2.LINE_AA, 4)

    circle = numpy.stack([numpy.cos(_CIRCLE), numpy.sin(_CIRCLE)], 1)
    fill(numpy.asarray(target, float) + RADIUS * circle, TARGET)
    arm = corners(joints)
    for begin, end in zip(arm, arm[1:]):
        along = (end - begin) / numpy.linalg.norm(end - begin)
        across = HALF * numpy.array([-along[1], along[0]])
        fill(numpy.array([begin + across, end + across, end - across, begin - across]), LINK)
    for point in arm:
        fill(point + HALF * circle, JOINT)
    return image


def moved(joints: Floats, command: Floats, seconds: float) -> Floats:
    """Return the angles of motors that follow a command for a time, with a limited speed."""
    most = 2 * FASTEST * seconds
    return joints + numpy.clip((command - joints) * min(1.0, seconds / LAG), -most, most)
