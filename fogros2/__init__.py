# SPDX-License-Identifier: Apache-2.0
"""
FogROS2: runs nodes of a ROS 2 launch file on machines in the cloud, created at launch.

What a launch file needs is here, imported when first asked for: ``import fogros2`` alone loads
neither launch nor an SDK.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fogros2.actions.cloud_group import CloudGroup
    from fogros2.actions.cloud_node import CloudNode
    from fogros2.actions.launch_description import FogROSLaunchDescription
    from fogros2.actions.machines import CloudInstance, ContainerInstance, SSHInstance
    from fogros2.errors import FogError
    from fogros2.image_transport.streams import StreamTopic

__all__ = [
    'CloudGroup',
    'CloudInstance',
    'CloudNode',
    'ContainerInstance',
    'FogError',
    'FogROSLaunchDescription',
    'SSHInstance',
    'StreamTopic',
]

_MODULES = {
    'CloudGroup': 'fogros2.actions.cloud_group',
    'CloudInstance': 'fogros2.actions.machines',
    'CloudNode': 'fogros2.actions.cloud_node',
    'ContainerInstance': 'fogros2.actions.machines',
    'FogError': 'fogros2.errors',
    'FogROSLaunchDescription': 'fogros2.actions.launch_description',
    'SSHInstance': 'fogros2.actions.machines',
    'StreamTopic': 'fogros2.image_transport.streams',
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
