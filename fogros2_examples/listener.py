# SPDX-License-Identifier: Apache-2.0
"""Prints what it hears on ``chatter``; ends after ``count`` messages if that parameter is set."""

from __future__ import annotations

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


class Listener(Node):
    """Listens; parameter ``count`` is the number of messages after which to end, 0 for never."""

    def __init__(self) -> None:
        super().__init__('listener')
        self.left = self.declare_parameter('count', 0).value
        self.create_subscription(String, 'chatter', self.hear, 10)

    def hear(self, message: String) -> None:
        """Print a message."""
        self.get_logger().info(f'I heard: [{message.data}]')
        if self.left:
            self.left -= 1
            if not self.left:
                raise SystemExit(0)


def main() -> None:
    """Run until interrupted, or until ``count`` messages were heard."""
    rclpy.init()
    try:
        rclpy.spin(Listener())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # the signal shuts rclpy down, in a thread of its own: a second one may be in its way
    except SystemExit:
        rclpy.try_shutdown()
        raise
