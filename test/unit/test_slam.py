# SPDX-License-Identifier: Apache-2.0
"""Visual SLAM of the examples, by value: geometry, matching, accuracy, data sets."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy
import pytest

cv2 = pytest.importorskip('cv2', reason='OpenCV (the extra "applications") is not installed')
pytest.importorskip('gtsam', reason='GTSAM (the extra "applications") is not installed')
pytest.importorskip('evo', reason='evo (the extra "applications") is not installed')

from fogros2_examples.files import BadInput  # noqa: E402
from fogros2_examples.slam import (  # noqa: E402
    geometry,
    mapping,
    matching,
    room,
    sources,
    stored,
    tum,
)
from fogros2_examples.slam.evaluation import accuracy  # noqa: E402
from fogros2_examples.slam.features import Features  # noqa: E402
from fogros2_examples.slam.pose import solve  # noqa: E402

WIDTH, HEIGHT = 320, 240


# --- geometry ------------------------------------------------------------------------------------

@pytest.mark.parametrize('vector', [(0, 0, 0), (0.1, -0.2, 0.3), (math.pi, 0, 0), (0, 3.1, 0.2),
                                    (0, 0, -2.5)])
def test_rotation_survives_conversion_to_quaternion(vector: Any) -> None:
    pose = geometry.from_vectors(vector, (1, 2, 3))
    again = geometry.from_quaternion(pose[:3, 3], geometry.quaternion(pose))
    assert numpy.allclose(again, pose, atol=1e-9)
    assert geometry.angle(pose) == pytest.approx(numpy.linalg.norm(vector), abs=1e-6)
    assert numpy.allclose(geometry.inverse(pose) @ pose, numpy.eye(4))


def test_quaternion_of_length_zero_is_refused() -> None:
    with pytest.raises(ValueError, match='length 0'):
        geometry.from_quaternion(numpy.zeros(3), numpy.zeros(4))


# --- matching, and the pose from matches ---------------------------------------------------------

def test_features_match_by_descriptor_and_distance() -> None:
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
def test_pose_is_found_among_outliers(deep: bool) -> None:
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


# --- accuracy ------------------------------------------------------------------------------------

def test_trajectory_errors_have_their_known_values() -> None:
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

CAMERA = room.camera(WIDTH, HEIGHT)
POSES = room.trajectory(40)[:5]
#: Colours and depths in millimetres of five frames.
FRAMES = [(numpy.full((HEIGHT, WIDTH, 3), 40 * number, numpy.uint8),
           numpy.arange(WIDTH * HEIGHT, dtype=numpy.uint16).reshape(HEIGHT, WIDTH) % 9000 + number)
          for number in range(5)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder in TUM's format with five frames and their true poses."""
    top, names = tmp_path / 'set', [f'{10 + number / 30:.6f}' for number in range(5)]
    for kind in ('rgb', 'depth'):
        (top / kind).mkdir(parents=True)
        (top / f'{kind}.txt').write_text(''.join(f'{name} {kind}/{name}.png\n' for name in names))
    for name, (image, depth) in zip(names, FRAMES):
        cv2.imwrite(str(top / f'rgb/{name}.png'), image)
        cv2.imwrite(str(top / f'depth/{name}.png'), 5 * depth)
    numpy.savetxt(top / 'groundtruth.txt', [
        (10.005 + number / 30, *pose[:3, 3], *geometry.quaternion(pose))
        for number, pose in enumerate(POSES)], header='time tx ty tz qx qy qz qw')
    (top / 'camera.txt').write_text(f'{CAMERA.fx} {CAMERA.fy} {CAMERA.cx} {CAMERA.cy}\n')
    return top


def test_dataset_is_read_as_it_was_written(folder: Path) -> None:
    source = sources.dataset(folder)
    assert source.count == 5
    assert (source.camera.fx, source.camera.cy) == (CAMERA.fx, CAMERA.cy)
    for shot, (image, depth), pose in zip(source.shots, FRAMES, POSES):
        assert (shot.image == image).all()
        assert (shot.depth == depth).all()
        assert numpy.allclose(shot.truth, pose, atol=1e-6)
    assert sources.dataset(folder, 2).count == 2


def test_colour_and_depth_are_paired_by_time(folder: Path) -> None:
    """An image whose depth is missing is left out, and nothing is used twice."""
    lines = (folder / 'depth.txt').read_text().splitlines()
    (folder / 'depth.txt').write_text('\n'.join(['# time file', *lines[:2], '', *lines[3:]]))
    (folder / 'groundtruth.txt').unlink()
    shots = list(sources.dataset(folder).shots)
    assert len(shots) == 4
    assert all(shot.truth is None for shot in shots)


def test_name_of_a_tum_dataset_selects_its_camera(folder: Path) -> None:
    (folder / 'camera.txt').unlink()
    assert tum.read(folder).camera.fx == 525.0
    renamed = folder.rename(folder.parent / 'rgbd_dataset_freiburg1_xyz')
    assert tum.read(renamed).camera.fx == 517.3


def test_lens_distortion_is_corrected(folder: Path) -> None:
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
def test_bad_dataset_is_reported_with_its_line(
    folder: Path, name: str, text: Any, said: str,
) -> None:
    if text is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(text)
    with pytest.raises(BadInput) as caught:
        list(sources.dataset(folder).shots)
    assert said in str(caught.value)


def test_saved_map_is_read_again(tmp_path: Path) -> None:
    """With its links, so that it can still be optimised; a damaged file is refused."""
    dice = numpy.random.default_rng(21)
    camera = geometry.Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    world = mapping.Map(camera)
    before = None
    for stamp in (1, 2, 3):
        features = Features(
            dice.uniform(0, 400, (50, 2)), dice.integers(0, 4, 50).astype(numpy.int32),
            dice.integers(0, 256, (50, 32)).astype(numpy.uint8), dice.uniform(1, 3, 50))
        pose = numpy.eye(4)
        pose[0, 3] = 0.3 * stamp
        before = world.add(stamp, pose, features, numpy.zeros(50, bool), before)
    file = tmp_path / 'maps/map.npz'
    stored.save(world, file)
    found = stored.load(camera, file)
    assert [(k.number, k.stamp, k.links) for k in found.keyframes] == [
        (k.number, k.stamp, k.links) for k in world.keyframes]
    for one, two in zip(found.keyframes, world.keyframes):
        assert (one.points == two.points).all() and (one.own == two.own).all()
        assert (one.features.descriptors == two.features.descriptors).all()
    found._optimise()
    assert numpy.allclose(found.keyframes[2].pose, world.keyframes[2].pose, atol=1e-6)
    assert [path.name for path in file.parent.iterdir()] == ['map.npz']
    file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(ValueError, match='is no map'):
        stored.load(camera, file)
