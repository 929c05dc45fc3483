# SPDX-License-Identifier: Apache-2.0
"""Grasp planning: grasps held against the meshes that the camera saw."""

from __future__ import annotations

import math

import numpy
import pytest

pytest.importorskip('fcl', reason='python-fcl is in the extra applications')
pytest.importorskip('cv2', reason='OpenCV is in the extra applications')

from fogros2_examples.grasp.antipodal import Gripper, plan
from fogros2_examples.grasp.bins import camera, depth_image, HEIGHT, thrown
from fogros2_examples.grasp.surface import surface
from fogros2_examples.meshes import box, joined, turned
from fogros2_examples.rendering import drawn


def seen_by(eye, depth):
    return surface(depth, (eye.focal, eye.focal), ((eye.width - 1) / 2, (eye.height - 1) / 2))


def rays(origin, way, corners):
    """Return what a ray hits: distances and indices (Moeller and Trumbore, 1997)."""
    a, b, c = corners.transpose(1, 0, 2)
    e, f = b - a, c - a
    p = numpy.cross(way, f)
    size = (e * p).sum(axis=1)
    there = numpy.abs(size) > 1e-12
    inverse = 1 / numpy.where(there, size, 1)
    s = origin - a
    q = numpy.cross(s, e)
    u, v, t = (s * p).sum(axis=1) * inverse, (q @ way) * inverse, (f * q).sum(axis=1) * inverse
    there &= (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return t[there], numpy.flatnonzero(there)


def antipodal_on(corners, eye, grasp, most):
    """Return whether both jaws meet a surface of the meshes within so many rad of its normal."""
    normals = numpy.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= numpy.linalg.norm(normals, axis=1, keepdims=True) + 1e-15
    centre = eye.centre + eye.rotation @ grasp.centre
    along = eye.rotation @ turned((0, 0, 1), grasp.angle)[:, 0]
    for sign in (1, -1):
        way = sign * along
        far, index = rays(centre - way * (grasp.width / 2 + 0.006), way, corners)
        if not len(far):
            return False
        if math.acos(min(1, max(-1, -normals[index[far.argmin()]] @ way))) > most:
            return False
    return True


def test_best_grasps_of_bins_are_antipodal():
    eye, gripper = camera(), Gripper()
    good = total = 0
    for seed in range(3):
        contents = thrown(seed)
        grasps = plan(seen_by(eye, depth_image(contents, eye, seed)), gripper, samples=600)
        assert [g.quality for g in grasps] == sorted((g.quality for g in grasps), reverse=True)
        assert all(0 < g.quality <= 1 and 0 < g.width < gripper.opening for g in grasps)
        # the sensor's noise, the grid and the jaws' breadth account for ten degrees
        most = math.atan(gripper.friction) + math.radians(10)
        held = [antipodal_on(contents.corners, eye, grasp, most) for grasp in grasps]
        assert held[0], seed
        good, total = good + sum(held), total + len(held)
    assert good >= 0.9 * total, (good, total)


def test_box_is_held_across_its_short_side():
    angle = 0.6
    contents = box((-0.06, -0.02, 0), (0.06, 0.02, 0.05)).moved(
        turned((0, 0, 1), angle), (0, 0, 0))
    eye = camera()
    floor = box((-0.3, -0.3, -0.01), (0.3, 0.3, 0))
    depth, _ = drawn(eye, joined([contents, floor]).corners)
    best = plan(seen_by(eye, depth), Gripper())[0]
    assert best.width == pytest.approx(0.04, abs=0.004)
    # the camera's y is opposite to the world's, and the jaws close across the box
    off = (best.angle + angle - math.pi / 2 + math.pi / 2) % math.pi - math.pi / 2
    assert abs(off) < 0.15
    assert 0.003 <= HEIGHT - best.centre[2] <= 0.05
