# SPDX-License-Identifier: Apache-2.0
"""Save a map as one file, which replaces the one before at once, and read it again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy

from fogros2_examples.slam.features import Features
from fogros2_examples.slam.geometry import Camera
from fogros2_examples.slam.mapping import Keyframe, Map

_FEATURES = ('pixels', 'octaves', 'descriptors', 'depths')
_OWN = ('stamp', 'pose', 'points', 'own', 'weights', 'telling')


def save(world: Map, path: Path) -> None:
    """
    Write a map.

    :raises OSError: it cannot be written; the file stays as it was.
    """
    arrays: dict[str, Any] = {
        'links': numpy.array([(one, two, wary) for one, two, _, wary in world.links], int),
        'between': numpy.array([between for _, _, between, _ in world.links])}
    for keyframe in world.keyframes:
        arrays.update({f'{keyframe.number} {name}': getattr(keyframe, name) for name in _OWN})
        arrays.update({f'{keyframe.number} {name}': getattr(keyframe.features, name)
                       for name in _FEATURES})
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_suffix('.new')
    with aside.open('wb') as stream:
        numpy.savez(stream, **arrays)
    aside.replace(path)


def load(camera: Camera, path: Path) -> Map:
    """
    Read a map; the file's arrays cannot contain programs.

    :raises ValueError: it is damaged.
    """
    world = Map(camera)
    try:
        with numpy.load(path, allow_pickle=False) as file:
            for number in range(sum(name.endswith(' stamp') for name in file)):
                stamp, *own = (file[f'{number} {name}'] for name in _OWN)
                features = Features(*(file[f'{number} {name}'] for name in _FEATURES))
                world.keyframes.append(
                    Keyframe(number, int(stamp), own[0], features, *own[1:]))
            for (one, two, wary), between in zip(file['links'], file['between']):
                world.link(world.keyframes[one], world.keyframes[two], between, bool(wary))
    except Exception as error:
        raise ValueError(f'{path} is no map: {error}') from error
    return world
