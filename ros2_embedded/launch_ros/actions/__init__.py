# SPDX-License-Identifier: Apache-2.0
"""What a launch can do with nodes."""
from launch._aliases import alias_submodules, missing

from ._composition import (
    ComposableNodeContainer,
    get_composable_node_load_request,
    LoadComposableNodes,
)
from ._lifecycle import LifecycleNode
from ._settings import (
    PushROSNamespace,
    SetParameter,
    SetParametersFromFile,
    SetRemap,
    SetROSLogDir,
)
from .node import Node

# Its name before Jazzy.
PushRosNamespace = PushROSNamespace

__all__ = [
    'ComposableNodeContainer', 'get_composable_node_load_request', 'LifecycleNode',
    'LoadComposableNodes', 'Node', 'PushROSNamespace', 'PushRosNamespace',
    'SetParameter', 'SetParametersFromFile', 'SetRemap', 'SetROSLogDir']

alias_submodules(__name__, __all__, load_composable_nodes=(
    'LoadComposableNodes', 'get_composable_node_load_request'))


def __getattr__(name: str) -> object:
    missing(__name__, name)
