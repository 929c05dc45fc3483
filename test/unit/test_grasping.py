# SPDX-License-Identifier: Apache-2.0
"""Grasp planning: depth, friction cones, obstacles, bad images and messages."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy
import pytest

pytest.importorskip('fcl', reason='python-fcl is in the extra applications')
pytest.importorskip('cv2', reason='OpenCV is in the extra applications')

from std_msgs.msg import Header

from fogros2_examples.grasp import antipodal, grasp_camera, messages
from fogros2_examples.grasp.antipodal import Gripper, margin, plan
from fogros2_examples.grasp.bins import camera, HEIGHT
from fogros2_examples.grasp.picture import beside, picture
from fogros2_examples.grasp.surface import CELL, NothingThere, Surface, surface
from fogros2_examples.meshes import box, cylinder, joined
from fogros2_examples.rendering import drawn


def seen_by(eye, depth):
    return surface(depth, (eye.focal, eye.focal), ((eye.width - 1) / 2, (eye.height - 1) / 2))


def test_depth_is_the_distance_to_the_meshes():
    eye = camera(320, 240)
    depth, index = drawn(eye, box((-0.3, -0.3, -0.01), (0.3, 0.3, 0.1)).corners)
    assert (index >= 0).all()
    assert depth == pytest.approx(numpy.full(depth.shape, HEIGHT - 0.1), abs=1e-5)


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
def test_margin_is_that_of_the_friction_cones(angle, friction, expected):
    found = margin(slopes_about(angle), numpy.array([[30 * CELL, 20 * CELL]]), numpy.zeros(1),
                   numpy.array([-0.02]), numpy.array([0.02]), friction)
    assert found == pytest.approx([expected], abs=0.01)


def test_blocked_sides_of_an_object_are_not_grasped():
    # a block with another right beside it: only the free pair of sides is left
    eye, floor = camera(), box((-0.3, -0.3, -0.01), (0.3, 0.3, 0))
    block = box((-0.02, -0.02, 0), (0.02, 0.02, 0.04))
    beside_it = box((0.023, -0.1, 0), (0.2, 0.1, 0.06))
    depth, _ = drawn(eye, joined([block, beside_it, floor]).corners)
    grasps = plan(seen_by(eye, depth), Gripper())
    on_it = [g for g in grasps if numpy.abs(g.centre[:2]).max() < 0.02]
    assert on_it and all(abs(g.angle) > 1.0 for g in on_it), on_it


def test_image_without_a_grasp_is_reported_with_its_cause():
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
def test_depth_survives_its_image_message(encoding):
    depth = numpy.array([[0, 0.5, 1.234], [0.7, 0, 2]], numpy.float32)
    message = messages.depth_message(depth, encoding, Header())
    assert messages.depth_of(message) == pytest.approx(depth, abs=1e-6)
    message.step += 2
    message.data = b''.join(
        bytes(message.data)[i:i + message.step - 2] + b'xx'
        for i in (0, message.step - 2))
    assert messages.depth_of(message) == pytest.approx(depth, abs=1e-6)
    message.encoding = 'bgr8'
    with pytest.raises(ValueError, match="depth as 'bgr8'"):
        messages.depth_of(message)
    message.encoding, message.height = encoding, 9
    with pytest.raises(ValueError, match='an image of 3x9'):
        messages.depth_of(message)


def test_grasps_survive_their_marker_messages():
    grasps = [antipodal.Grasp(numpy.array([0.1, -0.2, 0.6]), -1.2, 0.03, 0.765)]
    poses, markers = messages.grasp_messages(grasps, Header(frame_id='camera'))
    (back,) = messages.grasps_of(markers)
    assert back.centre == pytest.approx(grasps[0].centre) and back.angle == pytest.approx(-1.2)
    assert (back.width, back.quality) == (0.03, 0.765)
    assert poses.poses[0] == markers.markers[1].pose
    image = picture(numpy.full((60, 80), 0.6, numpy.float32), grasps, 100, 'one')
    assert beside([image] * 3, 2).shape == (90, 120, 3)


class SlowPlanner:
    """Answers depth images in order, each after ``seconds``; the first ``lost`` never come."""

    def __init__(self, monkeypatch, seconds, lost=0, wait=60.0):
        self.now, self.free, self.lost, self.due = 0.0, 0.0, lost, {}
        self.seconds_each = seconds
        self.camera = camera = grasp_camera.GraspCamera.__new__(grasp_camera.GraspCamera)
        camera.wait, camera.answers, camera.seconds = wait, {}, {}
        monkeypatch.setattr(camera, '_published', self.published)
        monkeypatch.setattr(grasp_camera, 'until', self.until)
        monkeypatch.setattr(grasp_camera, 'time', SimpleNamespace(monotonic=lambda: self.now))

    def published(self, depth):
        key = (round(self.now), len(self.due) + self.lost)
        if self.lost:
            self.lost -= 1
        else:
            self.free = self.due[key] = max(self.now, self.free) + self.seconds_each
        return key

    def until(self, node, true, wait):
        end = self.now + wait
        while not true() and self.now < end:
            self.now += 0.5
            for key, at in self.due.items():
                if at <= self.now:
                    self.camera.answers[key], self.camera.seconds[key] = [], self.seconds_each
        return true()


@pytest.mark.parametrize(('seconds', 'lost', 'works', 'images'), [
    (0.2, 0, True, 1), (14.0, 0, True, 2), (14.0, 2, True, 3), (50.0, 0, True, 4),
    (70.0, 0, False, 4), (0.2, 9, False, 4)])
def test_slow_planner_is_waited_for(monkeypatch, seconds, lost, works, images):
    planner = SlowPlanner(monkeypatch, seconds, lost)
    published = planner.published
    monkeypatch.setattr(planner.camera, '_published', lambda depth: asked.append(1) or published(
        depth))
    asked = []
    assert planner.camera._warm_up(None) is works
    assert len(asked) == images
    if works:
        assert planner.free <= planner.now, 'the first bin waits for no earlier image'
