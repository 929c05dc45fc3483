# SPDX-License-Identifier: Apache-2.0
"""
Serve the public names of replicated nodes on the robot: the first answer wins.

In reading order: ``figures`` has the figures of one replica, ``calls`` decides about requests of a
service and ``pairs`` about messages of an output topic, both without rclpy; ``node`` connects them
with the ROS graph.
"""
