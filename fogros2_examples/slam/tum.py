# SPDX-License-Identifier: Apache-2.0
"""
Read folders in the TUM RGB-D format (Sturm et al., IROS 2012).

``rgb.txt`` and ``depth.txt`` list images by time. ``groundtruth.txt`` lists poses as time,
position and quaternion. Depth is PNG with 16 bits, 5000 per metre. The format does not contain the
camera. It comes from the optional file ``camera.txt`` (``fx fy cx cy``, and ``k1 k2 p1 p2 k3`` of
Brown's model for distorted images). Otherwise it is TUM's own if the folder's name contains
freiburg1 to 3, else a Kinect's. Distorted images are rectified when they are read.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.files import BadInput
from fogros2_examples.letterbox import Pixels
from fogros2_examples.slam.geometry import Array, Camera, from_quaternion

#: Units of depth per metre.
SCALE = 5000
#: Maximum difference in seconds between an image and its depth or pose.
APART = 0.02
#: From TUM's page; the third camera's images are already rectified.
_CAMERAS: dict[str, tuple[float, ...]] = {
    'freiburg1': (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    'freiburg2': (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    'freiburg3': (535.4, 539.2, 320.1, 247.6)}
_KINECT = (525.0, 525.0, 319.5, 239.5)


@dataclasses.dataclass(frozen=True)
class Line:
    """
    A line of one of the lists.

    :param where: file and line, for messages.
    """

    time: float
    rest: tuple[str, ...]
    where: str


@dataclasses.dataclass(frozen=True)
class Dataset:
    """
    The content of a folder.

    :param distortion: k1, k2, p1, p2, k3 of the images in the folder; empty for no distortion.
    :param pairs: image and depth, by time.
    :param truth: poses by time; empty if unknown.
    """

    folder: Path
    camera: Camera
    distortion: tuple[float, ...]
    pairs: list[tuple[Line, Line]]
    truth: list[tuple[float, Array]]

    def frames(self) -> Iterator[tuple[float, Pixels, NDArray[numpy.uint16]]]:
        """
        Yield time, image (height, width, 3) of BGR, and depth (height, width), millimetres.

        Both are rectified; pixels outside of the original image are black or of unknown depth.

        :raises BadInput: a file is missing, or an image has another size.
        """
        maps = cv2.initUndistortRectifyMap(
            self.camera.matrix, numpy.array(self.distortion), None, self.camera.matrix,
            (self.camera.width, self.camera.height), cv2.CV_32FC1) if self.distortion else None
        for image, deep in self.pairs:
            colours = _image(self.folder, image, cv2.IMREAD_COLOR)
            depth = _image(self.folder, deep, cv2.IMREAD_UNCHANGED)
            if depth.dtype != numpy.uint16 or depth.shape != colours.shape[:2]:
                raise BadInput(f'{deep.where}: {deep.rest[0]} is no depth of 16 bits of the '
                                   f'size of {image.rest[0]}')
            size = (self.camera.height, self.camera.width)
            if depth.shape != size:
                raise BadInput(f'{image.where}: {image.rest[0]} is not of the size of the '
                                   'first image')
            if maps:
                colours = cv2.remap(colours, *maps, cv2.INTER_LINEAR)
                # Depths must not be interpolated between two surfaces.
                depth = cv2.remap(depth, *maps, cv2.INTER_NEAREST)
            yield image.time, colours, (depth.astype(int) * 1000 // SCALE).astype(numpy.uint16)


def read(folder: Path) -> Dataset:
    """
    Read the lists of a folder; images are read later.

    :raises BadInput: the folder does not have this format.
    """
    images, depths = (_lines(folder / name, 1) for name in ('rgb.txt', 'depth.txt'))
    pairs = _associated(images, depths)
    if not pairs:
        raise BadInput(f'{folder}: no image of rgb.txt has a depth image within '
                           f'{APART} seconds in depth.txt')
    truth = []
    if (folder / 'groundtruth.txt').exists():
        for line in _lines(folder / 'groundtruth.txt', 7):
            values = numpy.array([_number(word, line.where) for word in line.rest[:7]])
            try:
                truth.append((line.time, from_quaternion(values[:3], values[3:])))
            except ValueError as error:
                raise BadInput(f'{line.where}: {error}') from error
    first = _image(folder, pairs[0][0], cv2.IMREAD_COLOR)
    own = _camera(folder)
    return Dataset(folder, Camera(first.shape[1], first.shape[0], *own[:4]), own[4:], pairs, truth)


def _lines(path: Path, words: int) -> list[Line]:
    """Return the lines of a list, sorted by time."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f'{path}: {getattr(error, "strerror", None) or error}') from error
    lines = []
    for number, line in enumerate(text.splitlines(), 1):
        parts = line.replace(',', ' ').split()
        if not parts or parts[0].startswith('#'):
            continue
        where = f'{path}:{number}'
        if len(parts) < 1 + words:
            raise BadInput(f'{where}: {len(parts)} words where {1 + words} belong')
        lines.append(Line(_number(parts[0], where), tuple(parts[1:]), where))
    if not lines:
        raise BadInput(f'{path}: nothing in it')
    return sorted(lines, key=lambda line: line.time)


def _number(word: str, where: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise BadInput(f"{where}: '{word}' is no number") from None
    if not numpy.isfinite(value):
        raise BadInput(f"{where}: '{word}' is no number")
    return value


def _associated(images: list[Line], depths: list[Line]) -> list[tuple[Line, Line]]:
    """Return each image with the depth nearest in time; each depth belongs to one image."""
    times = numpy.array([line.time for line in depths])
    pairs: list[tuple[Line, Line]] = []
    taken = -1
    for image in images:
        nearest = int(numpy.argmin(numpy.abs(times - image.time)))
        if abs(times[nearest] - image.time) <= APART and nearest > taken:
            pairs.append((image, depths[nearest]))
            taken = nearest
    return pairs


def _image(folder: Path, line: Line, how: int) -> NDArray[Any]:
    image = cv2.imread(str(folder / line.rest[0]), how)
    if image is None:
        raise BadInput(f'{line.where}: {line.rest[0]} is missing, or no image')
    return numpy.asarray(image)


def _camera(folder: Path) -> tuple[float, ...]:
    """Return fx, fy, cx, cy, and the distortion if there is any."""
    values = next((c for name, c in _CAMERAS.items() if name in folder.resolve().name), _KINECT)
    path = folder / 'camera.txt'
    if path.exists():
        words = path.read_text().split()
        if len(words) not in (4, 9):
            raise BadInput(f'{path}:1: {len(words)} words where fx, fy, cx and cy belong, or '
                               'these with k1, k2, p1, p2 and k3')
        values = tuple(_number(word, f'{path}:1') for word in words)
    return values
