# SPDX-License-Identifier: Apache-2.0
"""What says of an action whether its node is meant."""
from __future__ import annotations

from typing import Any, Callable

__all__ = ['matches_node_name']


def matches_node_name(node_name: str) -> Callable[[Any], bool]:
    """Return a matcher for the node of that full name; '/' in front may be left out."""
    full_name = node_name if node_name.startswith('/') else f'/{node_name}'
    return lambda action: action.node_name == full_name
