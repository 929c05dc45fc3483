# SPDX-License-Identifier: Apache-2.0
"""Publish a greeting with the host's name on ``chatter``, at once and then every second."""

from __future__ import annotations

import socket

from rclpy.node import Node
from std_msgs.msg import String

from fogros2_examples.nodes import run


def own_address() -> str:
    """Return the address of this host towards other hosts, '127.0.0.1' if it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # connect() of a datagram socket sends nothing; it only looks up a route.
            probe.connect(('192.0.2.1', 9))
            return str(probe.getsockname()[0])
        except OSError:
            pass
    try:
        return socket.gethostbyname(socket.gethostname())
    except OSError:
        return '127.0.0.1'


class Talker(Node):
    """Publish greetings; parameter ``period`` is in seconds."""

    def __init__(self) -> None:
        super().__init__('talker')
        self.where = f'{socket.gethostname()} ({own_address()})'
        self.count = 0
        self.publisher = self.create_publisher(String, 'chatter', 10)
        self.greet()
        period = self.declare_parameter('period', 1.0).value
        self.create_timer(period, self.greet)

    def greet(self) -> None:
        """Publish the next greeting."""
        message = String(data=f'Hello World from {self.where}: {self.count}')
        self.publisher.publish(message)
        self.get_logger().info(f'Publishing: "{message.data}"')
        self.count += 1


def main() -> None:
    """Run until interrupted."""
    run('talker', Talker)
