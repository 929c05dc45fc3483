# SPDX-License-Identifier: Apache-2.0
"""The dashboard's node beside encoders and decoders, named as launches name them."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
import cv2
import numpy
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image

from fogros2.waiting import wait_until
from image_transport_h264.message import octets
from ros2fog_cli.api.graphs import Graph

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 96, 64


class Robot:
    """A node that publishes images of one colour each, thirty a second, and what it hears."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(os.environ['ROS_DOMAIN_ID']))
        self.node = Node('driver', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard: set[str] = set()
        self.processes: list[subprocess.Popen[bytes]] = []
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)

    def publish(self, topic: str, bgr: tuple[int, int, int]) -> None:
        """Publish an image of that colour from now on."""
        pixels = numpy.full((HEIGHT, WIDTH, 3), bgr, numpy.uint8)
        message = Image(width=WIDTH, height=HEIGHT, encoding='bgr8', step=3 * WIDTH,
                        data=octets(pixels.tobytes()))
        publisher = self.node.create_publisher(Image, topic, 2)
        self.node.create_timer(1 / 30, lambda: publisher.publish(message))

    def listen(self, topic: str) -> None:
        """Be one who wants a topic."""
        self.node.create_subscription(Image, topic, lambda _: self.heard.add(topic), 2)

    def start(self, role: str, name: str, image: str, stream: str) -> None:
        """Start an encoder or a decoder."""
        self.processes.append(subprocess.Popen(
            [sys.executable, str(ROOT / f'image_transport_h264/scripts/{role}'), '--ros-args',
             '-r', f'__node:={name}', '-r', f'image:={image}', '-p', f'stream:={stream}'],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

    def close(self) -> None:
        for process in self.processes:
            process.send_signal(signal.SIGINT)
        for process in self.processes:
            try:
                process.wait(60)
            finally:
                process.kill()
        self.executor.shutdown()
        self.thread.join(60)
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    yield made
    made.close()


@pytest.fixture
def graph() -> Iterator[Graph]:
    made = Graph(dict(os.environ))
    yield made
    made.close()


def colour(graph: Graph, topic: str) -> list[int]:
    """Return the colour in the middle of the last picture."""
    pixels = cv2.imdecode(numpy.frombuffer(graph.pictures[topic][1], numpy.uint8), -1)
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    middle: list[int] = pixels[HEIGHT // 2, WIDTH // 2].tolist()
    return middle


def near(found: list[int], bgr: tuple[int, int, int]) -> bool:
    return all(abs(one - other) < 25 for one, other in zip(found, bgr))


def test_dashboard_has_pictures_of_all_streams(robot: Robot, graph: Graph) -> None:
    red, blue = (40, 30, 220), (220, 60, 30)
    # from the robot to a machine, where one listens; and from one machine to another
    robot.publish('/camera', red)
    robot.publish('/fogros2/one/map', blue)
    robot.start('encoder', 'camera_h264_encoder', '/camera', '/camera/h264')
    robot.start('decoder', 'camera_h264_decoder_on_one', '/fogros2/one/camera', '/camera/h264')
    robot.start('encoder', 'map_h264_encoder_on_one', '/fogros2/one/map',
                '/fogros2/one/map/h264')
    robot.start('decoder', 'map_h264_decoder_from_one_on_two', '/fogros2/two/map',
                '/fogros2/one/map/h264')
    for topic in ('/fogros2/one/camera', '/fogros2/two/map'):
        robot.listen(topic)
    robot.thread.start()
    graph.know({'one': (), 'two': ()}, pictures=True)
    wait_until(lambda: len(robot.heard) == 2, timeout=60.0, what='streams that flow')
    wait_until(lambda: {'/camera', '/map'} <= graph.pictures.keys(), timeout=60.0,
               what='a picture of each')
    assert near(colour(graph, '/camera'), red) and near(colour(graph, '/map'), blue)
    found = {one['topic']: one for one in graph.state()}
    assert (found['/camera']['source'], found['/camera']['target']) == ('', 'one')
    assert (found['/map']['source'], found['/map']['target']) == ('one', 'two')

    def rates() -> bool:
        return all((one['rate'] or 0) > 5 and (one['bandwidth'] or 0) > 500
                   for one in graph.state())

    wait_until(rates, timeout=60.0, what='rates')
    number, camera = graph.pictures['/map'][0], graph.pictures['/camera'][0]
    wait_until(lambda: graph.pictures['/map'][0] > number, timeout=60.0, what='the next one')
    # one every 5 s, and one a second of the camera
    assert graph.pictures['/camera'][0] > 1
    assert graph.pictures['/camera'][0] - camera < 15
    # what the machines' nodes have in place of these topics is nobody's on the robot
    assert graph.alive and graph.topics == []
