# SPDX-License-Identifier: Apache-2.0
"""Print the messages of ``chatter``; exit after ``count`` messages if that parameter is set."""

from __future__ import annotations

from rclpy.node import Node
from std_msgs.msg import String

from fogros2_examples.nodes import run


class Listener(Node):
    """The listener; parameter ``count`` is the number of messages before it exits, 0: no limit."""

    def __init__(self) -> None:
        super().__init__('listener')
        self.remaining = self.declare_parameter('count', 0).value
        self.create_subscription(String, 'chatter', self.hear, 10)

    def hear(self, message: String) -> None:
        """Print a message."""
        self.get_logger().info(f'I heard: [{message.data}]')
        if self.remaining:
            self.remaining -= 1
            if not self.remaining:
                raise SystemExit(0)


def main() -> None:
    """Run until a signal, or until ``count`` messages have arrived."""
    run('listener', Listener)
