# SPDX-License-Identifier: Apache-2.0
"""A launch finds image topics that cross the VPN uncompressed, in the graph of real nodes."""

from __future__ import annotations

from collections.abc import Iterator
import os
import threading

import pytest

from fogros2.waiting import wait_until
from fogros2_features.streams import uncompressed
from rigs.domains import taken

rclpy = pytest.importorskip('rclpy', reason='neither ROS 2 nor the embedded default is here')


@pytest.fixture
def new_domain() -> Iterator[str]:
    """Have another: one keeps the configuration of its first participant in a process."""
    with taken() as domain:
        yield domain


def test_image_topic_between_two_hosts_is_found(
    monkeypatch: pytest.MonkeyPatch, new_domain: str,
) -> None:
    from sensor_msgs.msg import Image

    monkeypatch.setenv('ROS_DOMAIN_ID', new_domain)
    context = rclpy.context.Context()
    rclpy.init(context=context, domain_id=int(new_domain))
    camera, slam = (rclpy.create_node(name, context=context) for name in ('camera', 'slam'))
    camera.create_publisher(Image, '/camera/image_raw', 1)
    slam.create_subscription(Image, '/camera/image_raw', lambda _: None, 1)
    try:
        # on a busy computer, one inspection may end before it has discovered both nodes
        found = wait_until(lambda: uncompressed.crossing_images(
            {'planner': ['slam']}, os.environ, threading.Event()) or None,
            timeout=60, what='the topic')
        assert found == ['/camera/image_raw']
        assert uncompressed.crossing_images({}, os.environ, threading.Event()) == []
    finally:
        camera.destroy_node()
        slam.destroy_node()
        rclpy.shutdown(context=context)
