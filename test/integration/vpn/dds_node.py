#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A ROS 2 node for tests of the network: publishes and hears text with a number and a time.

Arguments: ``to:/topic`` publishes, ``from:/topic`` listens; ``--period`` seconds, ``--size``
bytes. Prints a JSON object a line: topic, number, latency (s) and arrival (s, on the computer's
monotonic clock, which all network namespaces share).
"""

import argparse
import json
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument('topics', nargs='+')
    parser.add_argument('--period', type=float, default=0.1)
    parser.add_argument('--size', type=int, default=0)
    arguments, _ = parser.parse_known_args()
    rclpy.init(args=[])
    node = Node('probe')
    publishers = [
        node.create_publisher(String, topic[3:], 10)
        for topic in arguments.topics if topic.startswith('to:')]
    padding = 'x' * arguments.size
    number = 0

    def publish() -> None:
        nonlocal number
        for publisher in publishers:
            publisher.publish(String(data=f'{number} {time.monotonic()!r} {padding}'))
        number += 1

    def heard(topic: str, message: String) -> None:
        arrival = time.monotonic()
        count, sent = message.data.split()[:2]
        print(json.dumps({'topic': topic, 'number': int(count), 'arrival': arrival,
                          'latency': arrival - float(sent)}), flush=True)

    for topic in arguments.topics:
        if topic.startswith('from:'):
            node.create_subscription(
                String, topic[5:], lambda message, topic=topic[5:]: heard(topic, message), 10)
    if publishers:
        node.create_timer(arguments.period, publish)
    print(json.dumps({'ready': True}), flush=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()


if __name__ == '__main__':
    main()
