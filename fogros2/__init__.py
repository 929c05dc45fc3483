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
    from fogros2.actions.choices import (
        find_cheapest,
        find_cheapest_ec2_instance_type,
        find_nearest_aws_region,
        nearest_aws_region_now,
    )
    from fogros2.actions.cloud_group import CloudGroup
    from fogros2.actions.fog_machine import FogMachine
    from fogros2.actions.foxglove import Foxglove
    from fogros2.actions.interruption import MachineInterrupted
    from fogros2.actions.launch_description import FogROSLaunchDescription
    from fogros2.actions.machines import CloudInstance, ContainerInstance, SSHInstance
    from fogros2.actions.machines_cloud import (
        AWSCloudInstance,
        AzureCloudInstance,
        GCPCloudInstance,
        KubeInstance,
    )
    from fogros2.actions.nodes import CloudNode, ComposableNodeContainer, LifecycleNode, Node
    from fogros2.errors import FogError
    from fogros2.image_transport.streams import StreamTopic

__all__ = [
    'AWSCloudInstance',
    'AzureCloudInstance',
    'CloudGroup',
    'CloudInstance',
    'CloudNode',
    'ComposableNodeContainer',
    'ContainerInstance',
    'FogError',
    'FogMachine',
    'FogROSLaunchDescription',
    'Foxglove',
    'GCPCloudInstance',
    'KubeInstance',
    'LifecycleNode',
    'MachineInterrupted',
    'Node',
    'SSHInstance',
    'StreamTopic',
    'ec2_instance_type_selection',
    'find_cheapest',
    'find_cheapest_ec2_instance_type',
    'find_nearest_aws_region',
    'nearest_aws_region_now',
    'region_ami_selection',
]

_MODULES = {
    'AWSCloudInstance': 'fogros2.actions.machines_cloud',
    'AzureCloudInstance': 'fogros2.actions.machines_cloud',
    'CloudGroup': 'fogros2.actions.cloud_group',
    'CloudInstance': 'fogros2.actions.machines',
    'CloudNode': 'fogros2.actions.nodes',
    'ComposableNodeContainer': 'fogros2.actions.nodes',
    'ContainerInstance': 'fogros2.actions.machines',
    'FogError': 'fogros2.errors',
    'FogMachine': 'fogros2.actions.fog_machine',
    'FogROSLaunchDescription': 'fogros2.actions.launch_description',
    'Foxglove': 'fogros2.actions.foxglove',
    'GCPCloudInstance': 'fogros2.actions.machines_cloud',
    'KubeInstance': 'fogros2.actions.machines_cloud',
    'LifecycleNode': 'fogros2.actions.nodes',
    'MachineInterrupted': 'fogros2.actions.interruption',
    'Node': 'fogros2.actions.nodes',
    'SSHInstance': 'fogros2.actions.machines',
    'StreamTopic': 'fogros2.image_transport.streams',
    'find_cheapest': 'fogros2.actions.choices',
    'find_cheapest_ec2_instance_type': 'fogros2.actions.choices',
    'find_nearest_aws_region': 'fogros2.actions.choices',
    'nearest_aws_region_now': 'fogros2.actions.choices',
}

#: Modules that FogROS2 has in a package ``utils``: ``from fogros2 import region_ami_selection``.
_FORMERLY_UTILS = {
    'ec2_instance_type_selection': 'fogros2.actions.choices',
    'region_ami_selection': 'fogros2.actions.choices',
}


def __getattr__(name: str) -> object:
    if name in _FORMERLY_UTILS:
        value = importlib.import_module(_FORMERLY_UTILS[name])
    elif name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
