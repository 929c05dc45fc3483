# SPDX-License-Identifier: Apache-2.0
"""Expansion of topics' and services' names."""

from rclpy._names import expand


def expand_topic_name(topic_name: str, node_name: str, node_namespace: str) -> str:
    """
    Expand a name for a node.

    :raises ValueError: if one of the three is invalid.
    """
    return expand(topic_name, node_name, node_namespace)
