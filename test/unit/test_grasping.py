# SPDX-License-Identifier: Apache-2.0
"""Grasp planning: grasps held against the meshes that the camera saw, and bad images."""

from __future__ import annotations

import math

import numpy
import pytest

pytest.importorskip('fcl', reason='python-fcl is in the extra applications')
pytest.importorskip('cv2', reason='OpenCV is in the extra applications')

from std_msgs.msg import Header

from fogros2_examples.grasp import antipodal, messages
from fogros2_examples.grasp.antipodal import Gripper, margin, plan
from fogros2_examples.grasp.bins import camera, depth_image, HEIGHT, thrown
from fogros2_examples.grasp.picture import beside, picture
from fogros2_examples.grasp.surface import CELL, NothingThere, Surface, surface
from fogros2_examples.meshes import box, cylinder, joined, turned
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


def test_depth_is_that_of_the_meshes():
    eye = camera(320, 240)
    depth, index = drawn(eye, box((-0.3, -0.3, -0.01), (0.3, 0.3, 0.1)).corners)
    assert (index >= 0).all()
    assert depth == pytest.approx(numpy.full(depth.shape, HEIGHT - 0.1), abs=1e-5)


def test_the_best_grasps_of_ten_bins_are_antipodal_on_their_meshes():
    eye, gripper = camera(), Gripper()
    good = total = 0
    for seed in range(10):
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


@pytest.mark.parametrize('angle', [0.0, 0.6, 1.5])
def test_a_box_is_held_across_its_short_side(angle):
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


def slopes_about(angle):
    """Return a surface that rises at its left and falls at its right, at an angle to x."""
    heights = numpy.zeros((40, 60), numpy.float32)
    slopes = numpy.zeros((40, 60, 2), numpy.float32)
    slopes[:, :30] = 50 * numpy.array([math.cos(angle), math.sin(angle)])
    slopes[:, 30:] = [-50, 0]
    return Surface(heights, heights, slopes, numpy.zeros(2), 0.7)


@pytest.mark.parametrize('angle, friction, expected', [
    (0.0, 0.5, 1 - 0.02 / 0.5), (0.2, 0.5, 1 - math.tan(0.2) / 0.5), (0.6, 0.5, 0.0),
    (0.6, 1.0, 1 - math.tan(0.6)), (3.0, 0.5, 0.0)])
def test_force_closure_is_a_matter_of_friction_cones(angle, friction, expected):
    found = margin(slopes_about(angle), numpy.array([[30 * CELL, 20 * CELL]]), numpy.zeros(1),
                   numpy.array([-0.02]), numpy.array([0.02]), friction)
    assert found == pytest.approx([expected], abs=0.01)


def test_what_is_in_the_way_is_not_grasped():
    # a block with another right beside it: only the free pair of sides is left
    eye, floor = camera(), box((-0.3, -0.3, -0.01), (0.3, 0.3, 0))
    block = box((-0.02, -0.02, 0), (0.02, 0.02, 0.04))
    beside_it = box((0.023, -0.1, 0), (0.2, 0.1, 0.06))
    depth, _ = drawn(eye, joined([block, beside_it, floor]).corners)
    grasps = plan(seen_by(eye, depth), Gripper())
    on_it = [g for g in grasps if numpy.abs(g.centre[:2]).max() < 0.02]
    assert on_it and all(abs(g.angle) > 1.0 for g in on_it), on_it


def test_there_may_be_nothing_to_grasp():
    eye = camera(320, 240)
    flat = numpy.full((240, 320), 0.7, numpy.float32)
    for depth, why in [
            (numpy.zeros((240, 320)), '0 of 76800 pixels have a depth'),
            (numpy.full((240, 320), numpy.nan), '0 of 76800 pixels'),
            (numpy.full((240, 320), numpy.inf), '0 of 76800 pixels'), (-flat, '0 of 76800'),
            (flat, 'nothing stands out'), (1e6 * flat, 'no bin within reach')]:
        with pytest.raises(NothingThere, match=why):
            plan(seen_by(eye, depth.astype(numpy.float32)), Gripper())
    # too broad for the jaws
    depth, _ = drawn(eye, joined([cylinder(0.1, 0.1), box((-1, -1, -0.1), (1, 1, 0))]).corners)
    with pytest.raises(NothingThere, match='face each other'):
        plan(seen_by(eye, depth), Gripper())


@pytest.mark.parametrize('encoding', ['16UC1', '32FC1'])
def test_depth_survives_its_message(encoding):
    depth = numpy.array([[0, 0.5, 1.234], [0.7, 0, 2]], numpy.float32)
    message = messages.depth_message(depth, encoding, Header())
    assert messages.depth_of(message) == pytest.approx(depth, abs=1e-6)
    message.step += 2
    message.data = b''.join(
        bytes(message.data)[i:i + message.step - 2] + b'xx'
        for i in (0, message.step - 2))
    assert messages.depth_of(message) == pytest.approx(depth, abs=1e-6)
    message.encoding = 'bgr8'
    with pytest.raises(messages.BadImage, match="'bgr8' is no encoding of depth"):
        messages.depth_of(message)
    message.encoding, message.height = encoding, 9
    with pytest.raises(messages.BadImage, match='are no image of 3x9'):
        messages.depth_of(message)


def test_grasps_survive_their_messages():
    grasps = [antipodal.Grasp(numpy.array([0.1, -0.2, 0.6]), -1.2, 0.03, 0.765)]
    poses, markers = messages.grasp_messages(grasps, Header(frame_id='camera'))
    (back,) = messages.grasps_of(markers)
    assert back.centre == pytest.approx(grasps[0].centre) and back.angle == pytest.approx(-1.2)
    assert (back.width, back.quality) == (0.03, 0.765)
    assert poses.poses[0] == markers.markers[1].pose
    image = picture(numpy.full((60, 80), 0.6, numpy.float32), grasps, 100, 'one')
    assert beside([image] * 3, 2).shape == (90, 120, 3)
