# SPDX-License-Identifier: Apache-2.0
"""Motion planning: scenes, the steps of a collision check, pictures, files of OMPL.app."""

from __future__ import annotations

import itertools
import math

import numpy
import pytest

pytest.importorskip('fcl', reason='python-fcl is in the extra applications')
base = pytest.importorskip('ompl.base', reason='ompl is in the extra applications')

from fogros2_examples.files import BadInput  # noqa: E402 - only where its libraries are
from fogros2_examples.meshes import (  # noqa: E402
    box,
    cylinder,
    quaternion,
    rotation,
    sphere,
    turned,
)
from fogros2_examples.planning.app_files import loaded  # noqa: E402
from fogros2_examples.planning.picture import between, picture, spaced  # noqa: E402
from fogros2_examples.planning.scene import pose  # noqa: E402
from fogros2_examples.planning.search import Space  # noqa: E402
from rigs.planning_room import box_room  # noqa: E402


def volume(mesh):
    a, b, c = mesh.corners.transpose(1, 0, 2)
    return float((a * numpy.cross(b, c)).sum() / 6)


def test_solids_are_closed_and_face_outwards():
    assert volume(box((0, 0, 0), (1, 2, 3))) == pytest.approx(6)
    assert volume(cylinder(1, 2, 200)) == pytest.approx(2 * math.pi, rel=1e-3)
    assert volume(sphere(1, 100)) == pytest.approx(4 / 3 * math.pi, rel=5e-3)
    for mesh in (box((0, 0, 0), (1, 1, 1)), cylinder(1, 1), sphere(1)):
        edges = [(t[i], t[(i + 1) % 3]) for t in mesh.triangles.tolist() for i in range(3)]
        assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)


@pytest.mark.parametrize('axis, angle', [
    ((0, 0, 1), 0.3), ((1, 0, 0), math.pi), ((1, 2, 3), 2.9), ((0, 1, 0), -math.pi / 2)])
def test_quaternions_and_matrices_agree(axis, angle):
    matrix = turned(axis, angle)
    assert rotation(quaternion(matrix)) == pytest.approx(matrix, abs=1e-12)
    assert numpy.trace(matrix) == pytest.approx(1 + 2 * math.cos(angle))


@pytest.mark.parametrize('end, farthest', [
    (pose(3.5, 0.5, 0.5), 3.0),
    # a corner of the cube goes along an arc
    (pose(0.5, 0.5, 0.5, yaw=3.0), 3.0 * 0.2 * math.sqrt(3))])
def test_ways_and_turns_are_checked_in_equal_steps(end, farthest):
    """In steps of a five hundredth of the diagonal for the body's outermost point."""
    room, looked = box_room(wall=False), itertools.count()
    states = Space(room).states
    space = base.SpaceInformation(states)
    space.setStateValidityChecker(lambda state: next(looked) >= 0)
    space.setup()
    motion = [states.allocState() for _ in range(2)]
    for state, (x, y, z, *turn) in zip(motion, (room.start, end)):
        state.setXYZ(x, y, z)
        state.rotation().x, state.rotation().y, state.rotation().z, state.rotation().w = turn
    assert space.checkMotion(*motion)
    assert next(looked) == math.ceil(farthest / (math.sqrt(4 ** 2 + 2 ** 2 + 2 ** 2) / 500))


def test_path_turns_the_shorter_way():
    path = numpy.array([pose(0, 0, 0), pose(1, 0, 0, yaw=1.0)])
    path[1, 3:] *= -1  # the same turn
    fine = between(path, 0.1, 0.1)
    assert len(fine) == 11
    for share, at in zip(numpy.linspace(0, 1, 11), fine):
        assert at[0] == pytest.approx(share)
        assert rotation(at[3:]) == pytest.approx(turned((0, 0, 1), share), abs=1e-9)
    assert spaced(path, 0.5)[:, 0] == pytest.approx([0, 0.5, 1], abs=0.03)


def test_picture_shows_start_and_goal():
    scene = box_room(wall=False)
    image = picture(scene, numpy.array([scene.start, scene.goal]), 'a room', width=200, height=150)
    assert image.shape == (150, 200, 3)
    assert (image < 200).any(axis=2).mean() > 0.05


CFG = """[problem]
robot = {robot}
world = walls.obj
start.x = 0.5
start.y = 0.5  # m
start.z = 0.5
start.theta = {theta}
start.axis.x = 0
start.axis.y = 0
start.axis.z = {axis}
goal.x = 3.5
goal.y = 0.5
goal.z = 0.5
goal.theta = 0
goal.axis.x = 0
goal.axis.y = 0
goal.axis.z = 0
volume.min.x = 0
volume.min.y = 0
volume.min.z = 0
volume.max.x = 4
volume.max.y = 2
volume.max.z = 2
[planner]
rrt=
aps=
aps=
"""


def write(path, mesh):
    path.write_text(''.join(
        [f"v {' '.join(map(str, v))}\n" for v in mesh.vertices.tolist()]
        + [f"f {' '.join(str(i + 1) for i in t)}\n" for t in mesh.triangles.tolist()]))


def test_problem_of_ompl_app_is_read(tmp_path):
    pytest.importorskip('trimesh', reason='trimesh is in the extra applications')
    room = box_room(wall=False)
    write(tmp_path / 'body.obj', room.body)
    write(tmp_path / 'walls.obj', room.walls)
    path = tmp_path / 'room.cfg'
    path.write_text(CFG.format(robot='body.obj', theta=1.5, axis=2))
    scene = loaded(path)
    assert scene.name == 'room' and len(scene.walls.triangles) == len(room.walls.triangles)
    assert scene.high.tolist() == [4, 2, 2]
    assert rotation(scene.start[3:]) == pytest.approx(turned((0, 0, 1), 1.5))
    assert scene.body.vertices.mean(axis=0) == pytest.approx(numpy.zeros(3), abs=1e-9)
    assert Space(scene).search(scene.start, scene.goal, seconds=20).end == 'found'
    for words, text in [
            ({'robot': 'none.obj'}, 'there is no .*none.obj'), ({'theta': 'x'}, 'could not'),
            ({'robot': 'room.cfg'}, "can't be read as a mesh")]:
        path.write_text(CFG.format(**{'robot': 'body.obj', 'theta': 0, 'axis': 1, **words}))
        with pytest.raises(BadInput, match=text):
            loaded(path)
    for text, said in [('[problem]\nworld=a\n', "has no 'robot'"),
                       ('nothing', "can't be read: File contains no section headers. file: ")]:
        path.write_text(text)
        with pytest.raises(BadInput, match=said):
            loaded(path)
    with pytest.raises(BadInput, match="missing.cfg can't be read: No such file or directory$"):
        loaded(tmp_path / 'missing.cfg')


@pytest.mark.parametrize('up, vertex', [('Y_UP', (1, 2, 3)), ('Z_UP', (1, 3, -2))])
def test_collada_file_is_read_with_its_up_axis(tmp_path, up, vertex):
    trimesh = pytest.importorskip('trimesh', reason='trimesh is in the extra applications')
    pytest.importorskip('collada', reason='pycollada is in the extra applications')
    mesh = box((0, 0, 0), (1, 2, 3))
    text = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).export(file_type='dae')
    (tmp_path / 'walls.dae').write_bytes(text.replace(b'Y_UP', up.encode()))
    assert up in (tmp_path / 'walls.dae').read_text()
    write(tmp_path / 'body.obj', mesh)
    path = tmp_path / 'room.cfg'
    path.write_text(CFG.format(robot='body.obj', theta=0, axis=1).replace('.obj\nst', '.dae\nst'))
    walls = loaded(path).walls
    assert numpy.ptp(walls.vertices, axis=0) == pytest.approx(numpy.abs(vertex))
    assert any(corner == pytest.approx(vertex) for corner in walls.vertices)
