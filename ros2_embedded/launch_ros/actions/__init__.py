# SPDX-License-Identifier: Apache-2.0
"""What a launch can do with nodes."""
from launch._aliases import alias_submodules, missing

from ._composition import ComposableNodeContainer, LoadComposableNodes
from ._composition import get_composable_node_load_request as get_composable_node_load_request
from ._lifecycle import LifecycleNode, LifecycleTransition
from ._ros_timer import ROSTimer
from ._settings import (
    PushROSNamespace,
    SetParameter,
    SetParametersFromFile,
    SetRemap,
    SetROSLogDir,
    SetUseSimTime,
)
from .node import Node

# The names of ROS 2 before Jazzy.
PushRosNamespace = PushROSNamespace
RosTimer = ROSTimer

__all__ = [
    'ComposableNodeContainer',
    'LifecycleNode',
    'LifecycleTransition',
    'LoadComposableNodes',
    'Node',
    'PushROSNamespace',
    'PushRosNamespace',
    'ROSTimer',
    'RosTimer',
    'SetParameter',
    'SetParametersFromFile',
    'SetRemap',
    'SetROSLogDir',
    'SetUseSimTime',
]

alias_submodules(__name__, __all__, {
    'load_composable_nodes': ('LoadComposableNodes', 'get_composable_node_load_request')})


def __getattr__(name: str) -> object:
    missing(__name__, name)
