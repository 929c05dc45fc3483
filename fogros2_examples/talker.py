# SPDX-License-Identifier: Apache-2.0
"""Publishes a greeting on ``chatter`` at once and then each second, saying where it runs."""

from __future__ import annotations

import socket

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


def own_address() -> str:
    """Return the address this host would use towards others, '127.0.0.1' if it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # connecting a datagram socket sends nothing; it only looks a route up
            probe.connect(('192.0.2.1', 9))
            return str(probe.getsockname()[0])
        except OSError:
            pass
    try:
        return socket.gethostbyname(socket.gethostname())
    except OSError:
        return '127.0.0.1'


class Talker(Node):
    """Greets; parameter ``period`` is in seconds."""

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
    rclpy.init()
    try:
        rclpy.spin(Talker())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # the signal shuts rclpy down, in a thread of its own: a second one may be in its way
