# SPDX-License-Identifier: Apache-2.0
"""
Pass topics on: between machines of several robots on one host, or at a limited rate.

Each machine that shares topics runs one relay. It has a folder, in which it makes a Unix socket,
and reads the folders of the others, which are mounted read-only: so a relay knows which machine it
reads from, and no machine can act as another. What a relay reads is checked there, because no
robot's machine is trusted by others.

In reading order: ``wire`` has the form of messages between relays and decides about them, without
rclpy; ``node`` connects the relays and the ROS graphs of their launches; ``limits`` is another
program, which passes topics between a robot and one machine at a limited rate.
"""
