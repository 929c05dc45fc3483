# SPDX-License-Identifier: Apache-2.0
"""Provide the frames of the SLAM example's camera: a TUM RGB-D folder, or the synthetic room."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from pathlib import Path
from typing import Optional

import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels
from fogros2_examples.slam import room, tum
from fogros2_examples.slam.geometry import Array, Camera


@dataclasses.dataclass(frozen=True)
class Shot:
    """
    The images of one frame.

    :param image: (height, width, 3) of BGR, the left one of a pair.
    :param depth: (height, width), millimetres; or ``right``, like ``image``.
    :param truth: pose of the camera, if it is known.
    """

    image: Pixels
    depth: Optional[NDArray[numpy.uint16]] = None
    right: Optional[Pixels] = None
    truth: Optional[Array] = None


@dataclasses.dataclass(frozen=True)
class Source:
    """
    A camera and its frames.

    :param shots: the frames, an iterator.
    :param count: number of frames.
    """

    camera: Camera
    shots: Iterator[Shot]
    count: int


def synthetic(width: int, height: int, count: int, stereo: bool, seed: int = 1) -> Source:
    """Return a walk through the synthetic room; all frames are rendered in advance."""
    camera = room.camera(width, height)
    made = room.Room(camera, seed)
    shots = []
    for number, pose in enumerate(room.trajectory(count)):
        if stereo:
            left, right = made.pair(pose, number)
            shots.append(Shot(left, right=right, truth=pose))
        else:
            image, depth = made.colour_and_depth(pose, number)
            shots.append(Shot(image, depth=depth, truth=pose))
    return Source(camera, iter(shots), count)


def dataset(folder: Path, count: int = 0) -> Source:
    """
    Return the frames of a TUM RGB-D folder; images are read on demand.

    :param count: maximum number of images, 0: all.
    :raises BadInput: the folder is invalid; ``shots`` raises it for a missing image.
    """
    sequence = tum.read(folder)
    pairs = sequence.pairs[:count or None]
    sequence = dataclasses.replace(sequence, pairs=pairs)
    times = numpy.array([time for time, _ in sequence.truth])

    def shots() -> Iterator[Shot]:
        for time, image, depth in sequence.frames():
            truth = None
            if len(times):
                nearest = int(numpy.argmin(numpy.abs(times - time)))
                if abs(times[nearest] - time) <= tum.APART:
                    truth = sequence.truth[nearest][1]
            yield Shot(image, depth=depth, truth=truth)

    return Source(sequence.camera, shots(), len(pairs))
