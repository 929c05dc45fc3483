# SPDX-License-Identifier: Apache-2.0
"""How many nodes of each name a launch has started."""
from collections import Counter
from typing import cast

from launch.launch_context import LaunchContext

_KEY = 'unique_ros_node_names'


def add_node_name(context: LaunchContext, node_name: str) -> None:
    """Count one more node of that full name."""
    if _KEY not in context.get_locals_as_dict():
        context.extend_globals({_KEY: Counter()})
    context.get_locals_as_dict()[_KEY][node_name] += 1


def get_node_name_count(context: LaunchContext, node_name: str) -> int:
    """Return how many nodes of that full name were counted."""
    return cast(int, context.get_locals_as_dict().get(_KEY, Counter())[node_name])
