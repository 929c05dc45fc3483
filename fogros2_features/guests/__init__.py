# SPDX-License-Identifier: Apache-2.0
"""
Guests of a machine: computers of other robots, which an invitation admits to its VPN.

On the machine: ``program`` keeps its guests, and is the door of their nodes. On both robots:
``network`` is what guests have of the VPN, ``sealing`` and ``invitation`` are the text that one
robot sends to the other. On the second robot: ``membership`` joins and leaves the VPN, ``shell``,
``provider`` and ``machine`` run nodes on the machine. On the first one: ``listing`` asks the
machine for its guests, and ``feature`` shows them; ``inviting`` changes them. ``verbs`` has the
verbs of ``ros2 fog``.
"""
