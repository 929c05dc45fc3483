# SPDX-License-Identifier: Apache-2.0
"""The dashboard's node beside encoders and decoders, named as launches name them."""

from __future__ import annotations

from collections.abc import Iterator
import os
import threading

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
import cv2
import numpy
from rclpy.node import Node
from sensor_msgs.msg import Image

from fogros2.waiting import wait_until
from fogros2_features.streams import uncompressed
from image_transport_h264.message import octets
from rigs.bench import Bench, RELIABLE
from ros2fog_cli.api.graphs import Graph

WIDTH, HEIGHT = 96, 64


@pytest.fixture
def graph(bench: Bench) -> Iterator[Graph]:
    made = Graph(dict(os.environ))
    yield made
    made.close()


def publish(bench: Bench, topic: str, bgr: tuple[int, int, int]) -> None:
    """Publish an image of that colour thirty times a second from now on."""
    pixels = numpy.full((HEIGHT, WIDTH, 3), bgr, numpy.uint8)
    message = Image(width=WIDTH, height=HEIGHT, encoding='bgr8', step=3 * WIDTH,
                    data=octets(pixels.tobytes()))
    publisher = bench.node.create_publisher(Image, topic, RELIABLE)
    bench.node.create_timer(1 / 30, lambda: publisher.publish(message))


def start(bench: Bench, role: str, name: str, image: str, stream: str) -> None:
    bench.start(role, '-r', f'__node:={name}', '-r', f'image:={image}', '-p', f'stream:={stream}')


def colour(graph: Graph, topic: str) -> list[int]:
    """Return the colour in the middle of the last picture."""
    pixels = cv2.imdecode(numpy.frombuffer(graph.pictures[topic][1], numpy.uint8), -1)
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    middle: list[int] = pixels[HEIGHT // 2, WIDTH // 2].tolist()
    return middle


def near(found: list[int], bgr: tuple[int, int, int]) -> bool:
    return all(abs(one - other) < 25 for one, other in zip(found, bgr))


def test_dashboard_has_pictures_of_all_streams(bench: Bench, graph: Graph) -> None:
    red, blue = (40, 30, 220), (220, 60, 30)
    # from the robot to a machine, where one listens; and from one machine to another
    publish(bench, '/camera', red)
    publish(bench, '/fogros2/one/map', blue)
    start(bench, 'encoder', 'camera_h264_encoder', '/camera', '/camera/h264')
    start(bench, 'decoder', 'camera_h264_decoder_on_one', '/fogros2/one/camera', '/camera/h264')
    start(bench, 'encoder', 'map_h264_encoder_on_one', '/fogros2/one/map', '/fogros2/one/map/h264')
    start(bench, 'decoder', 'map_h264_decoder_from_one_on_two', '/fogros2/two/map',
          '/fogros2/one/map/h264')
    heard = [bench.heard(Image, topic) for topic in ('/fogros2/one/camera', '/fogros2/two/map')]
    graph.know({'one': (), 'two': ()}, pictures=True)
    bench.until(lambda: all(heard), 'streams that flow')
    bench.until(lambda: {'/camera', '/map'} <= graph.pictures.keys(), 'a picture of each')
    # on a busy computer, the first image of a stream may be coarse
    bench.until(lambda: near(colour(graph, '/camera'), red) and near(colour(graph, '/map'), blue),
                'their colours')
    found = {one['topic']: one for one in graph.state()}
    assert (found['/camera']['source'], found['/camera']['target']) == ('', 'one')
    assert (found['/map']['source'], found['/map']['target']) == ('one', 'two')

    def rates() -> bool:
        return all((one['rate'] or 0) > 5 and (one['bandwidth'] or 0) > 500
                   for one in graph.state())

    bench.until(rates, 'rates')
    number, camera = graph.pictures['/map'][0], graph.pictures['/camera'][0]
    bench.until(lambda: graph.pictures['/map'][0] > number, 'the next one')
    # one every 5 s, and one a second of the camera
    assert graph.pictures['/camera'][0] > 1
    assert graph.pictures['/camera'][0] - camera < 15
    # what the machines' nodes have in place of these topics is nobody's on the robot
    assert graph.alive and graph.topics == []


def test_uncompressed_image_topic_between_two_hosts_is_found(bench: Bench) -> None:
    slam = Node('slam', context=bench.context)
    bench.node.create_publisher(Image, '/camera/image_raw', 1)
    slam.create_subscription(Image, '/camera/image_raw', lambda _: None, 1)
    try:
        # on a busy computer, one inspection may end before it has discovered both nodes
        found = wait_until(lambda: uncompressed.crossing_images(
            {'planner': ['slam']}, os.environ, threading.Event()) or None,
            timeout=60, what='the topic')
        assert found == ['/camera/image_raw']
    finally:
        slam.destroy_node()
