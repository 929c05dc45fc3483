# SPDX-License-Identifier: Apache-2.0
"""What a launch can do with nodes."""
from typing import NoReturn

from launch._aliases import alias_submodules

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


def __getattr__(name: str) -> NoReturn:
    if name in ('LifecycleTransition', 'ROSTimer', 'RosTimer', 'SetUseSimTime'):
        # Of an AttributeError an import statement wouldn't show the text.
        raise ImportError(
            f'{__name__}.{name} is not part of the embedded default: install ROS 2 '
            '(https://docs.ros.org/en/jazzy/Installation.html) and use that instead')
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
