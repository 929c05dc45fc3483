# SPDX-License-Identifier: Apache-2.0
"""Reads the problems of OMPL.app: a ``.cfg`` file, which names two mesh files beside it."""

from __future__ import annotations

import configparser
import math
from pathlib import Path
from typing import Any

import numpy

from fogros2_examples.meshes import Floats, joined, Mesh, quaternion, turned
from fogros2_examples.planning.scene import Scene


class BadFile(ValueError):
    """A file is no problem of a rigid body in space; the text says which, and what is wrong."""


def loaded(path: Path) -> Scene:
    """
    Return the problem in a file, in the file's own unit of length.

    :raises BadFile: it can't be read, lacks something, or a mesh can't.
    """
    # some have comments behind values, and keys with dots
    parser = configparser.ConfigParser(inline_comment_prefixes=('#', ';'))
    try:
        parser.read_string(path.read_text())
        problem = parser['problem']
        body, walls = (_mesh(path.parent / problem[name].strip('"'))
                       for name in ('robot', 'world'))
        poses = [_pose(problem, name) for name in ('start', 'goal')]
        if 'volume.min.x' in problem:
            low, high = (numpy.array([float(problem[f'volume.{end}.{axis}']) for axis in 'xyz'])
                         for end in ('min', 'max'))
        else:
            low, high = walls.vertices.min(axis=0), walls.vertices.max(axis=0)
    except (OSError, UnicodeDecodeError, configparser.Error) as error:
        raise BadFile(f"{path} can't be read: {error}") from error
    except KeyError as error:
        raise BadFile(f'{path} has no {error}: is it a problem of a body in space (SE(3))?'
                      ) from error
    except ValueError as error:
        raise BadFile(f'{path}: {error}') from error
    # poses in the file are of the mesh's frame; the bounds hold it as well
    return Scene(path.stem, body, walls, joined([]), low, high, poses[0], poses[1])


def _pose(problem: configparser.SectionProxy, name: str) -> Floats:
    """Return a pose: a position, and a turn about an axis in rad."""
    def number(key: str) -> float:
        return float(problem[f'{name}.{key}'])

    axis, angle = [number(f'axis.{one}') for one in 'xyz'], number('theta')
    if math.hypot(*axis) < 1e-9:
        axis, angle = [0.0, 0.0, 1.0], 0.0
    return numpy.array([*(number(one) for one in 'xyz'), *quaternion(turned(axis, angle))])


def _mesh(path: Path) -> Mesh:
    try:
        import trimesh
    except ImportError as error:
        raise BadFile(f"{path} can't be read without trimesh: pip install trimesh pycollada"
                      ) from error
    if not path.is_file():
        raise BadFile(f'there is no {path}')
    try:
        # all parts of it, where they stand in its scene
        found: Any = trimesh.load(path, force='mesh')
    except (ValueError, LookupError, AttributeError, TypeError, OSError, ImportError,
            NotImplementedError) as error:
        raise BadFile(f"{path} can't be read as a mesh: {error}") from error
    if not len(found.faces):
        raise BadFile(f'{path} has no triangles')
    return Mesh(numpy.array(found.vertices, float), numpy.array(found.faces, numpy.int32))
