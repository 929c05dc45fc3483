#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
The ends of a video stream for tests: ``camera`` publishes images, ``viewer`` takes them.

With ``best_effort`` behind it the viewer takes the camera's own images, larger and at 10 Hz. A
topic behind it, such as /left, replaces /camera, and /seen/left replaces /seen.

The viewer prints a JSON object an image: its number, latency and arrival (s, on the monotonic
clock that all network namespaces share), and for some how near it is to the original (dB).
"""

import array
import json
import math
import sys
import time

import numpy
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from fogros2_examples.scene import Scene

WIDTH, HEIGHT, FRAMES, RATE = 320, 240, 40, 30.0
COMPARED = 7


def frame(frames: list[numpy.ndarray], number: int) -> numpy.ndarray:
    """Return the frame of image ``number``: there and back, so that nothing jumps."""
    at = number % (2 * FRAMES - 2)
    return frames[at if at < FRAMES else 2 * FRAMES - 2 - at]


def main() -> None:
    raw = sys.argv[2:] == ['best_effort']
    width, height = (2 * WIDTH, 2 * HEIGHT) if raw else (WIDTH, HEIGHT)
    scene = Scene(width, height, RATE)
    frames = [scene.frame(number) for number in range(FRAMES)]
    topic = next((word for word in sys.argv[2:] if word.startswith('/')), None)
    qos = qos_profile_sensor_data if raw else 2
    rclpy.init(args=[])
    node = rclpy.create_node(sys.argv[1])
    count = 0

    def shoot() -> None:
        nonlocal count
        image = Image(width=width, height=height, encoding='bgr8', step=3 * width)
        image.data = array.array('B', frame(frames, count).tobytes())
        image.header.frame_id = f'{count} {time.monotonic()!r}'
        publisher.publish(image)
        count += 1

    def view(image: Image) -> None:
        arrival = time.monotonic()
        number, sent = image.header.frame_id.split()
        told = {'image': int(number), 'latency': arrival - float(sent), 'arrival': arrival}
        if int(number) % COMPARED == 0:
            pixels = numpy.frombuffer(image.data, numpy.uint8).reshape(height, width, 3)
            error = ((pixels.astype(int) - frame(frames, int(number))) ** 2).mean()
            told['psnr'] = 10 * math.log10(255 ** 2 / max(error, 1e-9))
        print(json.dumps(told), flush=True)

    if sys.argv[1] == 'camera':
        publisher = node.create_publisher(Image, topic or '/camera', qos)
        node.create_timer(0.1 if raw else 1 / RATE, shoot)
    else:
        node.create_subscription(Image, '/camera' if raw else topic or '/seen', view, qos)
    print(json.dumps({'ready': True}), flush=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()


if __name__ == '__main__':
    main()
