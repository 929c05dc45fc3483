# SPDX-License-Identifier: Apache-2.0
"""
Table II of the paper, visual SLAM: what applications.py calls for it.

A stereo camera of VGA in the synthetic room of the examples; a frame's time is from its
publication to the pose that bears its stamp, and the next one waits for that. In the last row two
frames are under way at once, as a camera's are: there it is the time from one pose to the next.
The trajectory's errors, as evo has them, are those of trajectories.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
import json
from pathlib import Path
import statistics
import subprocess
import tempfile
import time
from typing import Any, Optional

import applications
from applications import (
    favour,
    FOLDER,
    Held,
    ONE_THREAD,
    PACKETS,
    Result,
    robot_environment,
    running,
    words,
)
from figures import paper
import trajectories

#: The robot is held to as much less as the paper's fr2/loop is slower without the cloud. The paper
#: has no times of computing; its cloud computes at least so much faster.
RATIO = paper.SLAM['fr2/loop'][0] / paper.SLAM['fr2/loop'][3]
NODE, CAMERA = 'fogros2_examples.slam.node', 'fogros2_examples.slam.camera'
TOPICS = ('/camera/image', '/camera/right/image')
WIDTH, HEIGHT = 640, 480
#: The last one is H.264 of grey images, as most stereo cameras make them.
CODECS = ('raw', 'jpeg', 'h264', 'grey')
#: Frames at the beginning that don't count: the first key, libraries that load.
WARM_UP = 5


def walked(environment: dict[str, str], frames: int, ahead: int,
           grey: bool = False) -> dict[str, Any]:
    """Run the camera to its end; return what it measured, ``ahead`` frames under way at once."""
    said: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder, 'results')
        camera_words = words(CAMERA, f'frames:={frames}', 'rate:=200.0', f'ahead:={ahead}',
                             f'grey:={str(grey).lower()}', f'results:={results}')
        with running(camera_words, environment, said.append) as camera:
            camera.wait(600)
        if not results.exists():
            raise RuntimeError(f'{CAMERA} measured nothing:\n{"".join(said[-20:])}')
        found: dict[str, Any] = json.loads(results.read_text())
    return found


def here(frames: int, ahead: int, share: Optional[float], launch: Any,
         grey: bool = False) -> dict[str, Any]:
    """Run all on the robot; SLAM held to a share of a core, None for not."""
    environment = robot_environment(launch)
    with contextlib.ExitStack() as stack:
        held = None if share is None else Held(share)
        if held is not None:
            stack.callback(held.close)

        def hear(line: str) -> None:
            # not before it has started: loading libraries is no part of the figures
            if held is not None and 'no image yet' in line:
                held.take(node.pid)

        node = stack.enter_context(running(words(NODE), environment, hear))
        return walked(environment, frames, ahead, grey)


def there(codec: str, frames: int, ahead: int, launch: Any, machine: Any,
          link: Any) -> dict[str, Any]:
    """Run SLAM on the machine, over the link; return what was measured."""
    from streaming import end, LINK

    from fogros2.model import NodeSpec

    environment = robot_environment(launch)

    def coding(role: str, topic: str) -> list[str]:
        image = topic if role == 'encoder' else f'/there{topic}'
        form = 'h264' if codec == 'grey' else codec
        return [*words(f'image_transport_h264.{role}', f'codec:={form}',
                       f'stream:={topic}/stream'), '-r', f'image:={image}']

    computing = words(NODE)
    for topic in (*TOPICS, '/camera/camera_info', '/camera/right/camera_info'):
        computing += ['-r', f'{topic}:=/there{topic}']
    nodes = [('slam', computing), *(
        (f'decoder-{number}', coding('decoder', topic)) for number, topic in enumerate(TOPICS))]
    ids = [f'{what}-{codec}-{ahead}' for what, _ in nodes]
    link.change(rate=LINK, delay=0.0, loss=0.0)
    encoders: list[subprocess.Popen[bytes]] = []
    try:
        machine.start([NodeSpec(name, what, arguments=tuple(command),
                                environment={'PYTHONPATH': FOLDER, **ONE_THREAD})
                       for name, (what, command) in zip(ids, nodes)])
        encoders += [subprocess.Popen(coding('encoder', topic), env=environment,
                                      stdout=subprocess.DEVNULL) for topic in TOPICS]
        favour(f'from {NODE} import')
        return walked(environment, frames, ahead, codec == 'grey')
    finally:
        for encoder in encoders:
            end(encoder)
        machine.stop(ids)
        link.change(rate=0.0, delay=0.0, loss=0.0)


def coded_alone(codec: str) -> tuple[float, float]:
    """Return the seconds to encode and decode a pair of images one by one, and their bytes."""
    import cv2

    from fogros2_examples.slam.room import camera, Room, trajectory
    from image_transport_h264.codec import Decoder, Encoder, Picture

    room = Room(camera(WIDTH, HEIGHT))
    coder, decoder = Encoder(), Decoder()
    times, sizes = [], []
    for number, pose in enumerate(trajectory(10)):
        image = room.exact(pose)[0]
        if codec == 'grey':
            image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        size = image.nbytes
        begin = time.perf_counter()
        if codec == 'jpeg':
            coded = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
            size = len(coded)
            cv2.imdecode(coded, cv2.IMREAD_COLOR)
        elif codec != 'raw':
            picture = Picture(WIDTH, HEIGHT, 'mono8' if codec == 'grey' else 'bgr8',
                              image.nbytes // HEIGHT, memoryview(image.tobytes()))
            packet = coder.encode(picture, seconds=number / 10).data
            size = len(packet)
            decoder.decode(packet)
        times.append(time.perf_counter() - begin)
        sizes.append(size)
    return 2 * statistics.median(times), 2 * statistics.median(sizes)


def measured(only: str, short: bool, launch: Any, machine: Any, link: Any) -> Sequence[Result]:
    """Return the table's rows, one for each way that images cross."""
    return list(_measured(short, launch, machine, link)) if only in 'visual SLAM' else []


def _measured(short: bool, launch: Any, machine: Any, link: Any) -> Iterator[Result]:
    from streaming import LINK

    frames, held_frames, rooms = (60, 20, 2) if short else (200, 60, 12)
    errors = trajectories.measured(CODECS, rooms, frames)
    for codec in CODECS:
        grey = codec == 'grey'
        if codec in ('raw', 'grey'):
            # the robot's own camera is the same however its images would travel
            robot = statistics.median(
                here(held_frames, 1, 1 / RATIO, launch, grey)['round_trips'][WARM_UP:])
            hops = statistics.median(_network(here(frames, 1, None, launch, grey)))
        # over the link all frames would take too long as they are
        found = there(codec, 20 if codec == 'raw' else frames, 1, launch, machine, link)
        trips = found['round_trips'][WARM_UP:]
        total, network = statistics.median(trips), statistics.median(_network(found))
        coding, size = coded_alone(codec)
        yield Result(
            'visual SLAM', 'II', codec, robot, total - network, network, total, robot / total,
            RATIO,
            # an image is handed on once more on either side of the link
            PACKETS * size * 8 / LINK + coding + 3 * hops,
            PACKETS * size, len(trips), held_frames - WARM_UP, errors=errors[codec])
    for codec in ('h264', 'grey'):
        grey = codec == 'grey'
        robot, compute, total = (_pace(found, held_frames) for found in (
            here(held_frames, 2, 1 / RATIO, launch, grey),
            here(held_frames, 2, None, launch, grey),
            there(codec, held_frames, 2, launch, machine, link)))
        yield Result('visual SLAM, two frames under way', 'II', codec, robot, compute,
                     max(0.0, total - compute), total, robot / total, RATIO, 0.0,
                     PACKETS * coded_alone(codec)[1], held_frames - WARM_UP,
                     held_frames - WARM_UP)


def _pace(found: dict[str, Any], frames: int) -> float:
    """Return the seconds from one pose to the next."""
    came = found['came']
    if len(came) < frames:
        raise RuntimeError(f'{len(came)} of {frames} frames were answered')
    return float((came[-1] - came[WARM_UP]) / (frames - 1 - WARM_UP))


def _network(found: dict[str, Any]) -> list[float]:
    return [trip - computing for trip, computing in zip(
        found['round_trips'][WARM_UP:], found['computing'][WARM_UP:]) if computing == computing]


if __name__ == '__main__':
    applications.main()
