# SPDX-License-Identifier: Apache-2.0
"""Visual SLAM of the examples, by value: geometry, room, tracking, map, accuracy, data sets."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy
import pytest

cv2 = pytest.importorskip('cv2', reason='OpenCV (the extra "applications") is not installed')
pytest.importorskip('gtsam', reason='GTSAM (the extra "applications") is not installed')
pytest.importorskip('evo', reason='evo (the extra "applications") is not installed')

from fogros2_examples.slam import geometry, matching, room, sources, tum  # noqa: E402
from fogros2_examples.slam.evaluation import accuracy  # noqa: E402
from fogros2_examples.slam.features import Extractor, Features, with_depth, with_pair  # noqa: E402
from fogros2_examples.slam.pose import solve  # noqa: E402
from fogros2_examples.slam.tracking import Slam, State  # noqa: E402

WIDTH, HEIGHT = 320, 240
FRAMES, LAP = 100, 87


@pytest.fixture(scope='module')
def made() -> Any:
    return room.Room(room.camera(WIDTH, HEIGHT))


@pytest.fixture(scope='module')
def walk(made: Any) -> Any:
    """A walk through the room with an RGB-D camera."""
    return [(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), depth, pose)
            for number, pose in enumerate(room.trajectory(FRAMES, LAP))
            for image, depth in [made.colour_and_depth(pose, number)]]


# --- geometry ------------------------------------------------------------------------------------

@pytest.mark.parametrize('vector', [(0, 0, 0), (0.1, -0.2, 0.3), (math.pi, 0, 0), (0, 3.1, 0.2),
                                    (0, 0, -2.5)])
def test_rotations_there_and_back(vector: Any) -> None:
    pose = geometry.from_vectors(vector, (1, 2, 3))
    again = geometry.from_quaternion(pose[:3, 3], geometry.quaternion(pose))
    assert numpy.allclose(again, pose, atol=1e-9)
    assert geometry.angle(pose) == pytest.approx(numpy.linalg.norm(vector), abs=1e-6)
    assert numpy.allclose(geometry.inverse(pose) @ pose, numpy.eye(4))


def test_a_quaternion_without_direction_is_refused() -> None:
    with pytest.raises(ValueError, match='length 0'):
        geometry.from_quaternion(numpy.zeros(3), numpy.zeros(4))


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
def test_depth_is_the_distance(made: Any, pose: Any, metres: float) -> None:
    _, depth = made.exact(pose)
    assert depth[HEIGHT // 2, WIDTH // 2] == pytest.approx(metres, abs=0.01)
    _, noisy = made.colour_and_depth(pose, 1)
    assert numpy.median(noisy[100:140, 140:180]) == pytest.approx(1000 * metres, abs=20)


def test_frames_are_always_the_same_and_neighbours_differ(made: Any) -> None:
    pose = room.trajectory(50, LAP)[7]
    left, right = made.pair(pose, 3)
    assert (made.pair(pose, 3)[0] == left).all()
    assert (made.pair(pose, 4)[0] != left).any()
    assert (left != right).mean() > 0.5
    assert 40 < left.mean() < 220
    assert left.std() > 20


# --- features ------------------------------------------------------------------------------------

def test_features_are_spread_and_have_depths(made: Any) -> None:
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
def test_a_blank_image_has_no_features(made: Any, image: Any) -> None:
    found = Extractor(made.camera).extract(image)
    assert len(found) == 0
    assert len(with_pair(found, image, image, made.camera)) == 0


def test_depths_that_are_none(made: Any) -> None:
    some = Features(numpy.array([[1.0, 1], [2, 1], [3, 1], [4, 1]]), numpy.zeros(4, numpy.int32),
                    numpy.zeros((4, 32), numpy.uint8), numpy.full(4, numpy.nan))
    image = numpy.zeros((HEIGHT, WIDTH), numpy.float32)
    image[1, 1:5] = math.nan, 0.0, math.inf, 1.5
    assert with_depth(some, image, made.camera).deep.tolist() == [False, False, False, True]


# --- matching, and the pose from matches ---------------------------------------------------------

def test_matches_are_alike_and_near() -> None:
    random = numpy.random.default_rng(3)
    one = random.integers(0, 256, (80, 32), dtype=numpy.uint8)
    order = random.permutation(80)
    two = one[order].copy()
    two[:, 0] ^= 1  # a bit each
    first, second = matching.match(one, two)
    assert (order[second] == first).all()
    assert len(first) == 80
    places = random.uniform(0, 300, (80, 2))
    there = places[order] + 2
    there[5] += 50  # too far away
    first, second = matching.match_near(one, places, two, there, 10)
    assert (order[second] == first).all()
    assert sorted(second) == [n for n in range(80) if n != 5]
    nothing = numpy.empty((0, 32), numpy.uint8), numpy.empty((0, 2))
    assert len(matching.match_near(*nothing, two, there, 10)[0]) == 0
    assert len(matching.match_near(one, places, *nothing, 10)[0]) == 0


@pytest.mark.parametrize('deep', [True, False])
def test_the_pose_is_found_among_outliers(deep: bool) -> None:
    camera, random = room.camera(), numpy.random.default_rng(5)
    pose = geometry.from_vectors((0.1, -0.3, 0.05), (0.4, -0.1, 0.2))
    seen = random.uniform((-1, -1, 1.5), (1, 1, 5), (200, 3))
    pixels = camera.project(seen) + random.normal(0, 0.3, (200, 2))
    wrong = random.choice(200, 60, replace=False)
    pixels[wrong] += random.uniform(15, 60, (60, 2))
    features = Features(pixels, numpy.zeros(200, numpy.int32), numpy.zeros((200, 32), numpy.uint8),
                        seen[:, 2] if deep else numpy.full(200, numpy.nan))
    found = solve(camera, geometry.moved(pose, seen), features, 20)
    assert found is not None
    off = geometry.inverse(pose) @ found.pose
    assert numpy.linalg.norm(off[:3, 3]) < 0.005
    assert geometry.angle(off) < 0.002
    assert not found.inliers[wrong].any()
    assert found.support > 125
    assert solve(camera, geometry.moved(pose, seen), features, 150) is None
    assert solve(camera, seen[:3], features.chosen(numpy.arange(3)), 3) is None


# --- SLAM ----------------------------------------------------------------------------------------

def error(slam: Slam, truth: dict[int, Any]) -> float:
    found = slam.trajectory()
    return accuracy([truth[stamp] for stamp, _ in found], [pose for _, pose in found]).ate


def test_a_walk_with_depth(made: Any, walk: Any) -> None:
    """Within 3 cm of the truth; it sees that it comes back, and the map gets no bigger there."""
    slam = Slam(made.camera)
    for number, (grey, depth, _) in enumerate(walk):
        tracked = slam.track(number, grey, depth=depth)
        assert tracked.state is State.TRACKING, (number, tracked.why)
        slam.extend(tracked)
    assert error(slam, {n: pose for n, (_, _, pose) in enumerate(walk)}) < 0.03
    assert slam.map.loops >= 1
    assert 10 < len(slam.map.keyframes) < FRAMES // 2
    points = slam.map.points(slam.map.keyframes).places
    start = walk[0][2]
    world = geometry.moved(start, points)
    inside = ((world > -0.1) & (world < numpy.array(room.SIZE) + 0.1)).all(1)
    assert inside.mean() > 0.95


def test_a_walk_with_two_eyes(made: Any) -> None:
    slam = Slam(made.camera)
    poses = room.trajectory(40, LAP)
    for number, pose in enumerate(poses):
        left, right = (cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in made.pair(pose, number))
        tracked = slam.track(number, left, right=right)
        assert tracked.state is State.TRACKING, (number, tracked.why)
        slam.extend(tracked)
    # a disparity of a pixel is 16 cm at a wall, in images so small
    assert error(slam, dict(enumerate(poses))) < 0.05


def test_lost_and_found_again(made: Any, walk: Any) -> None:
    """A covered lens, then another place of the room: lost; back where it was: it knows."""
    slam = Slam(made.camera)
    for number, (grey, depth, _) in enumerate(walk[:25]):
        slam.extend(slam.track(number, grey, depth=depth))
    keyframes = len(slam.map.keyframes)
    for number in range(3):
        covered = slam.track(100 + number, numpy.zeros((HEIGHT, WIDTH), numpy.uint8),
                             depth=walk[0][1])
        assert (covered.state, covered.pose) == (State.LOST, None)
        assert covered.why == '0 features in the image'
        assert not slam.extend(covered)
    elsewhere = slam.track(110, walk[60][0], depth=walk[60][1])
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


def test_no_start_without_depth_or_features(made: Any, walk: Any) -> None:
    slam, grey = Slam(made.camera), walk[0][0]
    empty = slam.track(0, grey, depth=numpy.zeros((HEIGHT, WIDTH), numpy.uint16))
    assert empty.state is State.STARTING
    assert empty.why.startswith('0 of ')
    blank = slam.track(1, numpy.full_like(grey, 80), depth=walk[0][1])
    assert (blank.state, blank.why) == (State.STARTING, '0 features in the image')
    with pytest.raises(ValueError, match='an image of 100x50 from a camera of 320x240'):
        slam.track(2, numpy.zeros((50, 100), numpy.uint8), depth=walk[0][1])
    assert slam.track(3, grey, depth=walk[0][1]).state is State.TRACKING


# --- accuracy ------------------------------------------------------------------------------------

def test_errors_are_what_they_are_called() -> None:
    truth = room.trajectory(60)
    # in another frame of the world: that is no error
    other = geometry.from_vectors((0.2, 0.4, -1.0), (5, 6, 7))
    same = accuracy(truth, [other @ pose for pose in truth])
    assert same.ate < 1e-9
    assert same.rpe < 1e-9
    # every second pose a centimetre up, the others a centimetre down
    shaken = [pose.copy() for pose in truth]
    for number, pose in enumerate(shaken):
        pose[2, 3] += 0.01 * (-1) ** number
    off = accuracy(truth, shaken)
    assert off.ate == pytest.approx(0.01, rel=0.02)
    assert 0.005 < off.rpe < 0.025
    assert math.isnan(accuracy(truth[:4], truth[:4]).rpe)


# --- data sets -----------------------------------------------------------------------------------

@pytest.fixture
def folder(tmp_path: Path, made: Any) -> Path:
    poses = room.trajectory(40)[:5]
    frames = [(10 + number / 30, *made.colour_and_depth(pose, number))
              for number, pose in enumerate(poses)]
    tum.write(tmp_path / 'set', made.camera, frames,
              [(10.005 + number / 30, pose) for number, pose in enumerate(poses)])
    return tmp_path / 'set'


def test_a_folder_there_and_back(folder: Path, made: Any) -> None:
    source = sources.dataset(folder)
    assert source.count == 5
    assert (source.camera.fx, source.camera.cy) == (made.camera.fx, made.camera.cy)
    for number, (shot, pose) in enumerate(zip(source.shots, room.trajectory(40))):
        image, depth = made.colour_and_depth(pose, number)
        assert (shot.image == image).all()
        assert (shot.depth == depth).all()
        assert numpy.allclose(shot.truth, pose, atol=1e-6)
    assert sources.dataset(folder, 2).count == 2


def test_what_belongs_together_by_time(folder: Path) -> None:
    """An image whose depth is missing is left out, and nothing is used twice."""
    lines = (folder / 'depth.txt').read_text().splitlines()
    (folder / 'depth.txt').write_text('\n'.join(['# time file', *lines[:2], '', *lines[3:]]))
    (folder / 'groundtruth.txt').unlink()
    shots = list(sources.dataset(folder).shots)
    assert len(shots) == 4
    assert all(shot.truth is None for shot in shots)


def test_tums_own_cameras(folder: Path) -> None:
    (folder / 'camera.txt').unlink()
    assert tum.read(folder).camera.fx == 525.0
    renamed = folder.rename(folder.parent / 'rgbd_dataset_freiburg1_xyz')
    assert tum.read(renamed).camera.fx == 517.3


def test_what_a_lens_bends_is_straightened(folder: Path) -> None:
    """TUM's first camera moves the corners of its images by five pixels and more."""
    renamed = folder.rename(folder.parent / 'rgbd_dataset_freiburg1_xyz')
    (renamed / 'camera.txt').unlink()
    camera = geometry.Camera(640, 480, 517.3, 516.5, 318.6, 255.3)
    straight = numpy.array([(20.0, 30), (320, 240), (600, 60), (60, 440), (590, 450)])
    bent = cv2.projectPoints(
        camera.lift(straight, numpy.ones(5)), numpy.zeros(3), numpy.zeros(3), camera.matrix,
        numpy.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633]))[0].reshape(-1, 2)
    assert numpy.abs(bent - straight).max() > 5
    image = numpy.zeros((480, 640, 3), numpy.uint8)
    depth = numpy.zeros((480, 640), numpy.uint16)
    for metres, (x, y) in enumerate(bent.round().astype(int), 1):
        image[y - 4:y + 5, x - 4:x + 5] = 255
        depth[y - 4:y + 5, x - 4:x + 5] = 5000 * metres
    for name, picture in (('rgb', image), ('depth', depth)):
        cv2.imwrite(str(renamed / f'{name}.png'), picture)
        (renamed / f'{name}.txt').write_text(f'1.0 {name}.png\n')
    shot, = sources.dataset(renamed).shots
    for metres, (x, y) in enumerate(straight, 1):
        around = shot.image[int(y) - 12:int(y) + 13, int(x) - 12:int(x) + 13, 0].astype(float)
        rows, columns = numpy.indices(around.shape)
        assert (columns * around).sum() / around.sum() - 12 == pytest.approx(0, abs=0.8)
        assert (rows * around).sum() / around.sum() - 12 == pytest.approx(0, abs=0.8)
        assert shot.depth[int(y), int(x)] == 1000 * metres


@pytest.mark.parametrize(('name', 'text', 'said'), [
    ('rgb.txt', None, 'rgb.txt: No such file'),
    ('rgb.txt', '# nothing\n', 'rgb.txt: nothing in it'),
    ('rgb.txt', '# x\n10.0\n', 'rgb.txt:2: 1 words where 2 belong'),
    ('depth.txt', 'ten depth/x.png\n', "depth.txt:1: 'ten' is no number"),
    ('depth.txt', 'nan depth/x.png\n', "depth.txt:1: 'nan' is no number"),
    ('depth.txt', '99.0 depth/x.png\n', 'no image of rgb.txt has a depth image within'),
    ('rgb.txt', '10.0 rgb/x.png\n', 'rgb.txt:1: rgb/x.png is missing, or no image'),
    ('depth.txt', '10.0 depth.txt\n', 'depth.txt:1: depth.txt is missing, or no image'),
    ('depth.txt', '10.0 rgb/10.000000.png\n', 'is no depth of 16 bits'),
    ('groundtruth.txt', '1 2 3\n', 'groundtruth.txt:1: 3 words where 8 belong'),
    ('groundtruth.txt', '1 0 0 0 0 0 0 0\n', 'groundtruth.txt:1: a quaternion of length 0'),
    ('camera.txt', '500 500\n', 'camera.txt:1: 2 words'),
])
def test_a_malformed_folder_says_where(folder: Path, name: str, text: Any, said: str) -> None:
    if text is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(text)
    with pytest.raises(tum.DatasetError) as caught:
        list(sources.dataset(folder).shots)
    assert said in str(caught.value)
