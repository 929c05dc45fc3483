# SPDX-License-Identifier: Apache-2.0
"""
Carry listed topics between the machines of several robots on one host.

Each machine runs one relay. It has a folder, in which it makes a Unix socket, and reads the
folders of the others, which are mounted read-only: so a relay knows which machine it reads from,
and no machine can act as another. What a relay reads is checked there, because no robot's machine
is trusted by others.

In reading order: ``wire`` has the form of messages between relays and decides about them, without
rclpy; ``node`` connects the relays and the ROS graphs of their launches.
"""
