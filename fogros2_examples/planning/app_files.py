# SPDX-License-Identifier: Apache-2.0
"""Read problems of OMPL.app: a ``.cfg`` file that names two mesh files beside it."""

from __future__ import annotations

import configparser
import math
from pathlib import Path
from typing import Any

import numpy

from fogros2_examples.files import BadInput
from fogros2_examples.meshes import Floats, joined, Mesh, quaternion, turned
from fogros2_examples.planning.scene import Scene

#: Rotation of a file's up axis to y by Assimp, with which OMPL.app reads meshes.
_UPRIGHT = {'X_UP': numpy.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
            'Z_UP': numpy.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}


def loaded(path: Path) -> Scene:
    """
    Read the problem of a file, in the file's unit of length.

    :raises BadInput: the file or a mesh cannot be read, or a value is missing.
    """
    # Some files have comments after values, and define a planner twice.
    parser = configparser.ConfigParser(
        strict=False, interpolation=None, inline_comment_prefixes=('#', ';'))
    try:
        parser.read_string(path.read_text())
        problem = parser['problem']
        # As in OMPL.app, a pose is the pose of the body's centre.
        body, walls = (_mesh(path.parent / problem[name].strip('"'), centred=name == 'robot')
                       for name in ('robot', 'world'))
        poses = [_pose(problem, name) for name in ('start', 'goal')]
        if 'volume.min.x' in problem:
            low, high = (numpy.array([float(problem[f'volume.{end}.{axis}']) for axis in 'xyz'])
                         for end in ('min', 'max'))
        else:
            low, high = walls.vertices.min(axis=0), walls.vertices.max(axis=0)
    except (OSError, UnicodeDecodeError, configparser.Error) as error:
        why = getattr(error, 'strerror', None) or ' '.join(str(error).split())
        raise BadInput(f"{path} can't be read: {why}") from error
    except KeyError as error:
        raise BadInput(f'{path} has no {error}: is it a problem of a body in space (SE(3))?'
                      ) from error
    except ValueError as error:
        raise BadInput(f'{path}: {error}') from error
    return Scene(path.stem, body, walls, joined([]), low, high, poses[0], poses[1])


def _pose(problem: configparser.SectionProxy, name: str) -> Floats:
    """Parse a pose: a position, and a rotation about an axis in rad."""
    def number(key: str) -> float:
        return float(problem[f'{name}.{key}'])

    axis, angle = [number(f'axis.{one}') for one in 'xyz'], number('theta')
    if math.hypot(*axis) < 1e-9:
        axis, angle = [0.0, 0.0, 1.0], 0.0
    return numpy.array([*(number(one) for one in 'xyz'), *quaternion(turned(axis, angle))])


def _triangles(path: Path) -> tuple[Floats, Floats]:
    """Return the triangles' corners (n, 3, 3), and the vertices for the mean of the file."""
    try:
        if path.suffix.lower() == '.dae':
            import collada

            file = collada.Collada(str(path))
            parts = [part.triangleset() if hasattr(part, 'triangleset') else part
                     for geometry in file.scene.objects('geometry')
                     for part in geometry.primitives()]
            # The other primitives are lines.
            parts = [part for part in parts if part.vertex_index is not None
                     and part.vertex_index.ndim == 2 and part.vertex_index.shape[1] == 3]
            triangles = numpy.concatenate(
                [part.vertex[part.vertex_index] for part in parts] or [numpy.empty((0, 3, 3))])
            # OMPL.app counts a corner once for each normal that its surface has there.
            normals = numpy.concatenate([
                numpy.zeros((len(part.vertex_index), 3, 3)) if part.normal is None
                else part.normal[part.normal_index] for part in parts] or [triangles])
            both = numpy.concatenate([triangles, normals], axis=2).reshape(-1, 6)
            turn = _UPRIGHT.get(str(file.assetInfo.upaxis), numpy.eye(3))
            counted = numpy.unique(both.round(5), axis=0)[:, :3]
            return triangles.astype(float) @ turn.T, counted @ turn.T
        import trimesh

        mesh: Any = trimesh.load(path, force='mesh', process=False)
    except ImportError as error:
        raise BadInput(f"{path} can't be read: {error}; pip install trimesh pycollada") from error
    vertices = numpy.array(mesh.vertices, float)
    return vertices[numpy.array(mesh.faces, int)].reshape(-1, 3, 3), vertices


def _mesh(path: Path, *, centred: bool) -> Mesh:
    """Read a mesh; ``centred`` moves the mean of its vertices to the origin."""
    if not path.is_file():
        raise BadInput(f'there is no {path}')
    try:
        triangles, counted = _triangles(path)
    except BadInput:
        raise
    except (ValueError, LookupError, AttributeError, TypeError, OSError, SyntaxError,
            NotImplementedError) as error:
        raise BadInput(f"{path} can't be read as a mesh: {error}") from error
    if not len(triangles):
        raise BadInput(f'{path} has no triangles')
    if centred:
        triangles = triangles - counted.mean(axis=0)
    vertices, indices = numpy.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(vertices, indices.reshape(-1, 3).astype(numpy.int32))
