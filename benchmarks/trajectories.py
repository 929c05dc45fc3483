# SPDX-License-Identifier: Apache-2.0
"""
What lossy images cost a trajectory: SLAM in many rooms, each with raw and with coded images.

Nothing crosses a link here: the codecs and the algorithm are those of the nodes, the images the
same for all. SLAM's error in one room says little: an image that differs by one grey level has it
start on another way, whose error is up to a third, sometimes a half, more or less. So the ratio
of errors is the geometric mean over rooms, with the interval in which it lies at 95 %.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
import dataclasses
import math
import multiprocessing
import os
from pathlib import Path
import statistics
import sys
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
WIDTH, HEIGHT = 640, 480
JPEG_QUALITY = 80


@dataclasses.dataclass(frozen=True)
class Errors:
    """
    Medians of rooms; cm, and cm a metre.

    :param ratio: of ATE to that with raw images, ``low`` and ``high`` its 95 % interval.
    """

    ate: float
    rpe: float
    ratio: float
    low: float
    high: float
    rooms: int


def measured(codecs: Sequence[str], rooms: int, frames: int) -> dict[str, Errors]:
    """
    Return the errors with each codec; two rooms at a time.

    :param codecs: of applications_slam; 'raw' is the first.
    """
    with ProcessPoolExecutor(2, multiprocessing.get_context('spawn')) as pool:
        found = list(pool.map(_room, range(1, rooms + 1), [codecs] * rooms, [frames] * rooms))
    return {codec: _summary([room[0] for room in found], [room[at] for room in found])
            for at, codec in enumerate(codecs)}


def _summary(raw: Sequence[tuple[float, float]], other: Sequence[tuple[float, float]]) -> Errors:
    logs = [math.log(two[0] / one[0]) for one, two in zip(raw, other)]
    middle = statistics.fmean(logs)
    # the normal distribution's 1.96 would be too narrow for so few: Student's t, nearly
    spread = (1.96 + 2.5 / (len(logs) - 1)) * statistics.stdev(logs) / math.sqrt(len(logs))
    return Errors(statistics.median(one[0] for one in other),
                  statistics.median(one[1] for one in other),
                  math.exp(middle), math.exp(middle - spread), math.exp(middle + spread),
                  len(logs))


def _room(seed: int, codecs: Sequence[str], frames: int) -> list[tuple[float, float]]:
    """Return ATE and RPE in a room, with each codec; in a process of its own."""
    os.environ['OMP_NUM_THREADS'] = '1'
    import cv2

    from fogros2_examples.slam.room import camera, Room, trajectory

    cv2.setNumThreads(1)
    room, poses = Room(camera(WIDTH, HEIGHT), seed), trajectory(frames)
    pairs = [room.pair(pose, number) for number, pose in enumerate(poses)]
    return [_errors(zip(*(coded(codec, side) for side in zip(*pairs))), poses)
            for codec in codecs]


def _errors(pairs: Iterator[tuple[Any, ...]], poses: Sequence[Any]) -> tuple[float, float]:
    import cv2

    from fogros2_examples.slam.evaluation import accuracy
    from fogros2_examples.slam.room import camera
    from fogros2_examples.slam.tracking import Slam

    slam = Slam(camera(WIDTH, HEIGHT))
    for number, pair in enumerate(pairs):
        left, right = (image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
                       for image in pair)
        slam.extend(slam.track(number, left, right=right))
    way = slam.trajectory()
    found = accuracy([poses[number] for number, _ in way], [pose for _, pose in way])
    return 100 * found.ate, 100 * found.rpe


def coded(codec: str, images: Sequence[Any]) -> Iterator[Any]:
    """
    Yield images (height, width, 3) of BGR as they come out of a codec.

    :param codec: 'raw', 'jpeg', 'h264', or 'grey' for H.264 of grey images, which come out so.
    """
    import cv2
    import numpy

    from image_transport_h264.codec import Decoder, Encoder, Picture

    encoder, decoder = Encoder(), Decoder()
    for number, image in enumerate(images):
        if codec == 'jpeg':
            quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
            yield cv2.imdecode(cv2.imencode('.jpg', image, quality)[1], cv2.IMREAD_COLOR)
        elif codec in ('h264', 'grey'):
            if codec == 'grey':
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            picture = Picture(WIDTH, HEIGHT, 'mono8' if codec == 'grey' else 'bgr8',
                              image.nbytes // HEIGHT, memoryview(image.tobytes()))
            shown = decoder.decode(encoder.encode(picture, seconds=number / 10).data)
            assert shown is not None
            yield numpy.frombuffer(shown.data, numpy.uint8).reshape(image.shape)
        else:
            yield image


if __name__ == '__main__':
    for name, errors in measured(('raw', 'jpeg', 'h264', 'grey'), 12, 200).items():
        print(name, errors)
