# SPDX-License-Identifier: Apache-2.0
"""What a launch can do with nodes."""
from embedded_default.lacking import lacking

from ._composition import ComposableNodeContainer as ComposableNodeContainer
from ._composition import get_composable_node_load_request as get_composable_node_load_request
from ._composition import LoadComposableNodes as LoadComposableNodes
from ._lifecycle import LifecycleNode as LifecycleNode
from ._settings import *  # noqa: F403
from ._settings import PushROSNamespace as PushROSNamespace
from .node import Node as Node

PushRosNamespace = PushROSNamespace  # its name before Jazzy
__getattr__ = lacking(__name__, 'LifecycleTransition ROSTimer RosTimer SetUseSimTime')
