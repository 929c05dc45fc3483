# SPDX-License-Identifier: Apache-2.0
"""What verbs ask for the graph: always a node of this process, there is no daemon."""

from ros2cli.node.direct import add_arguments
from ros2cli.node.direct import DirectNode as NodeStrategy

__all__ = ['add_arguments', 'NodeStrategy']
