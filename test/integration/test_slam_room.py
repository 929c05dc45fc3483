# SPDX-License-Identifier: Apache-2.0
"""Visual SLAM of the examples in the drawn room: images, features, walks with two cameras."""

from __future__ import annotations

import math
from typing import Any

import numpy
import pytest

cv2 = pytest.importorskip('cv2', reason='OpenCV (the extra "applications") is not installed')
pytest.importorskip('gtsam', reason='GTSAM (the extra "applications") is not installed')
pytest.importorskip('evo', reason='evo (the extra "applications") is not installed')

from fogros2_examples.slam import geometry, room  # noqa: E402
from fogros2_examples.slam.evaluation import accuracy  # noqa: E402
from fogros2_examples.slam.features import Extractor, Features, with_depth, with_pair  # noqa: E402
from fogros2_examples.slam.tracking import Slam, State  # noqa: E402

WIDTH, HEIGHT = 320, 240
FRAMES, LAP = 66, 58


@pytest.fixture(scope='module')
def made() -> Any:
    return room.Room(room.camera(WIDTH, HEIGHT))


@pytest.fixture(scope='module')
def walk(made: Any) -> Any:
    """A walk through the room with an RGB-D camera."""
    return [(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), depth, pose)
            for number, pose in enumerate(room.trajectory(FRAMES, LAP))
            for image, depth in [made.colour_and_depth(pose, number)]]


# --- the room ------------------------------------------------------------------------------------

def facing(x: float, y: float, z: float, yaw: float) -> Any:
    """Return the pose of a level camera."""
    pose = numpy.eye(4)
    pose[:3, 0] = math.sin(yaw), -math.cos(yaw), 0
    pose[:3, 1] = 0, 0, -1
    pose[:3, 2] = math.cos(yaw), math.sin(yaw), 0
    pose[:3, 3] = x, y, z
    return pose


@pytest.mark.parametrize(('pose', 'metres'), [
    (facing(3, 2, 2.2, 0.0), 3.0),            # the wall at x = 6
    (facing(3, 2, 1.0, math.pi), 2.65),       # the book case before the one at x = 0
    (facing(3, 2, 1.2, math.pi / 2), 3.0),    # over a chest of drawers, the wall at y = 5
    (facing(3, 2, 0.5, math.pi / 2 - 1e-9), 0.25)])  # the stool in the middle
def test_depth_is_the_distance_to_the_surface(made: Any, pose: Any, metres: float) -> None:
    _, depth = made.exact(pose)
    assert depth[HEIGHT // 2, WIDTH // 2] == pytest.approx(metres, abs=0.01)
    _, noisy = made.colour_and_depth(pose, 1)
    assert numpy.median(noisy[100:140, 140:180]) == pytest.approx(1000 * metres, abs=20)


def test_frames_are_reproducible_and_differ(made: Any) -> None:
    pose = room.trajectory(50, LAP)[7]
    left, right = made.pair(pose, 3)
    assert (made.pair(pose, 3)[0] == left).all()
    assert (made.pair(pose, 4)[0] != left).any()
    assert (left != right).mean() > 0.5
    assert 40 < left.mean() < 220
    assert left.std() > 20


# --- features ------------------------------------------------------------------------------------

def test_features_are_spread_and_have_true_depths(made: Any) -> None:
    """From stereo images within the accuracy that a fifth of a pixel gives, nearly all of them."""
    camera, pose = made.camera, room.trajectory(50, LAP)[10]
    _, exact = made.exact(pose)
    left, right = (cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in made.pair(pose, 0))
    plain = Extractor(camera, 500).extract(left)
    assert 300 < len(plain) <= 500
    assert not plain.deep.any()
    found = with_pair(plain, left, right, camera)
    columns, rows = numpy.round(found.pixels).astype(int).T
    true = exact[rows, columns]
    assert found.deep.mean() > 0.7
    disparity = camera.fx * camera.baseline * numpy.abs(1 / found.depths - 1 / true)
    assert numpy.nanmedian(disparity) < 0.2
    assert numpy.nanquantile(disparity, 0.9) < 1.0
    quarters = {(x > WIDTH / 2, y > HEIGHT / 2) for x, y in found.pixels}
    assert len(quarters) == 4
    assert numpy.allclose(with_depth(plain, exact, camera).depths, true)


@pytest.mark.parametrize('image', [
    numpy.zeros((HEIGHT, WIDTH), numpy.uint8), numpy.full((HEIGHT, WIDTH), 255, numpy.uint8)])
def test_blank_image_has_no_features(made: Any, image: Any) -> None:
    found = Extractor(made.camera).extract(image)
    assert len(found) == 0
    assert len(with_pair(found, image, image, made.camera)) == 0


def test_invalid_depths_are_left_out(made: Any) -> None:
    some = Features(numpy.array([[1.0, 1], [2, 1], [3, 1], [4, 1]]), numpy.zeros(4, numpy.int32),
                    numpy.zeros((4, 32), numpy.uint8), numpy.full(4, numpy.nan))
    image = numpy.zeros((HEIGHT, WIDTH), numpy.float32)
    image[1, 1:5] = math.nan, 0.0, math.inf, 1.5
    assert with_depth(some, image, made.camera).deep.tolist() == [False, False, False, True]


# --- SLAM ----------------------------------------------------------------------------------------

def error(slam: Slam, truth: dict[int, Any]) -> float:
    found = slam.trajectory()
    return accuracy([truth[stamp] for stamp, _ in found], [pose for _, pose in found]).ate


def test_walk_with_depth_is_accurate_and_closes_loop(made: Any, walk: Any) -> None:
    """Within 3 cm of the truth; it sees that it comes back, and the map gets no bigger there."""
    slam = Slam(made.camera)
    for number, (grey, depth, _) in enumerate(walk):
        tracked = slam.track(number, grey, depth=depth)
        assert tracked.state is State.TRACKING, (number, tracked.why)
        slam.extend(tracked)
    assert error(slam, {n: pose for n, (_, _, pose) in enumerate(walk)}) < 0.03
    assert slam.map.loops >= 1
    assert 10 < len(slam.map.keyframes) < 40
    points = slam.map.points(slam.map.keyframes).places
    start = walk[0][2]
    world = geometry.moved(start, points)
    inside = ((world > -0.1) & (world < numpy.array(room.SIZE) + 0.1)).all(1)
    assert inside.mean() > 0.95


def test_walk_with_stereo_is_accurate(made: Any) -> None:
    slam = Slam(made.camera)
    poses = room.trajectory(20, LAP)
    for number, pose in enumerate(poses):
        left, right = (cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in made.pair(pose, number))
        tracked = slam.track(number, left, right=right)
        assert tracked.state is State.TRACKING, (number, tracked.why)
        slam.extend(tracked)
    # a disparity of a pixel is 16 cm at a wall, in images so small
    assert error(slam, dict(enumerate(poses))) < 0.05


def test_lost_camera_finds_its_place_again(made: Any, walk: Any) -> None:
    """A covered lens, then another place of the room: lost; back where it was: it knows."""
    slam = Slam(made.camera)
    for number, (grey, depth, _) in enumerate(walk[:17]):
        slam.extend(slam.track(number, grey, depth=depth))
    keyframes = len(slam.map.keyframes)
    for number in range(3):
        covered = slam.track(100 + number, numpy.zeros((HEIGHT, WIDTH), numpy.uint8),
                             depth=walk[0][1])
        assert (covered.state, covered.pose) == (State.LOST, None)
        assert covered.why == '0 features in the image'
        assert not slam.extend(covered)
    elsewhere = slam.track(110, walk[40][0], depth=walk[40][1])
    assert (elsewhere.state, elsewhere.why) == (State.LOST, 'nothing known is in view')
    assert len(slam.map.keyframes) == keyframes
    back = slam.track(111, walk[5][0], depth=walk[5][1])
    assert back.state is State.TRACKING
    assert back.pose is not None
    off = geometry.inverse(geometry.inverse(walk[0][2]) @ walk[5][2]) @ back.pose
    assert numpy.linalg.norm(off[:3, 3]) < 0.05
    # and goes on, over an image without any depth too
    blind = slam.track(112, walk[6][0], depth=numpy.zeros((HEIGHT, WIDTH), numpy.uint16))
    assert blind.state is State.TRACKING


def test_slam_starts_only_with_depth_and_features(made: Any, walk: Any) -> None:
    slam, grey = Slam(made.camera), walk[0][0]
    empty = slam.track(0, grey, depth=numpy.zeros((HEIGHT, WIDTH), numpy.uint16))
    assert empty.state is State.STARTING
    assert empty.why.startswith('0 of ')
    blank = slam.track(1, numpy.full_like(grey, 80), depth=walk[0][1])
    assert (blank.state, blank.why) == (State.STARTING, '0 features in the image')
    with pytest.raises(ValueError, match='an image of 100x50 from a camera of 320x240'):
        slam.track(2, numpy.zeros((50, 100), numpy.uint8), depth=walk[0][1])
    assert slam.track(3, grey, depth=walk[0][1]).state is State.TRACKING
