# SPDX-License-Identifier: Apache-2.0
"""What verbs ask for the graph: always a node of this process, there is no daemon."""

import argparse

from ros2cli.node.direct import add_arguments as add_direct_node_arguments
from ros2cli.node.direct import DirectNode


class NodeStrategy(DirectNode):
    """The node of this process."""

    @property
    def direct_node(self) -> DirectNode:
        """Itself."""
        return self


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of such a node."""
    add_direct_node_arguments(parser)
    parser.add_argument(
        '--no-daemon', action='store_true',
        help='Do not spawn nor use an already running daemon')
