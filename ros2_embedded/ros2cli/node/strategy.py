# SPDX-License-Identifier: Apache-2.0
"""What verbs ask for the graph: always a node of this process, there is no daemon."""

from typing import Any

from ros2cli.node.direct import add_arguments as add_direct_node_arguments
from ros2cli.node.direct import DirectNode as NodeStrategy

__all__ = ['add_arguments', 'NodeStrategy']


def add_arguments(parser: Any) -> None:
    """Add the options of such a node."""
    add_direct_node_arguments(parser)
    parser.add_argument('--no-daemon', action='store_true', help='Changes nothing here')
