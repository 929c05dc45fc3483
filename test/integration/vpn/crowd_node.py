#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Many participants of ROS 2 in one process: each context of rclpy is one.

Arguments: the number of participants, the number of all that are to be known, a name. Prints
``known`` whenever the number of nodes changes that the participant knows of which knows fewest.
"""

import json
import signal
import sys
import time

import rclpy
from rclpy.context import Context
from rclpy.node import Node


def main() -> None:
    count, everybody, name = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    nodes = []
    for number in range(count):
        context = Context()
        rclpy.init(args=[], context=context)
        nodes.append(Node(f'{name}_{number}', context=context))
    print(json.dumps({'ready': True}), flush=True)
    before = -1
    while before < everybody:
        known = min(len(set(node.get_node_names())) for node in nodes)
        if known != before:
            print(json.dumps({'known': known}), flush=True)
            before = known
        time.sleep(0.3)
    signal.pause()  # others have to know these


if __name__ == '__main__':
    main()
