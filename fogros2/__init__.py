# SPDX-License-Identifier: Apache-2.0
"""
Run nodes of a ROS 2 launch file on machines in the cloud, created at launch.

The public names for launch files are here. Each is imported at its first use: ``import fogros2``
alone loads neither launch nor an SDK.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fogros2.actions.cloud_group import CloudGroup
    from fogros2.actions.fog_machine import FogMachine
    from fogros2.actions.launch_description import FogROSLaunchDescription
    from fogros2.actions.nodes import CloudNode, ComposableNodeContainer, LifecycleNode, Node
    from fogros2.describe.choices import (
        find_cheapest,
        find_cheapest_ec2_instance_type,
        find_nearest_aws_region,
        nearest_aws_region_now,
    )
    from fogros2.describe.machines import (
        CloudInstance,
        ContainerInstance,
        SSHInstance,
    )
    from fogros2.describe.machines_cloud import (
        AWSCloudInstance,
        AzureCloudInstance,
        cheapest,
        CheapestInstance,
        GCPCloudInstance,
        KubeInstance,
    )
    from fogros2.errors import FogError
    from fogros2.runtime.interruption import MachineInterrupted
    from fogros2_features.guests.machine import JoinedMachine
    from fogros2_features.replicas.action import Replicated
    from fogros2_features.streams.entries import StreamTopic
    from fogros2_monitor.action import Foxglove

#: Written out for type checkers, which do not run the module.
__all__ = [
    'AWSCloudInstance', 'AzureCloudInstance', 'CheapestInstance', 'CloudGroup',
    'CloudInstance', 'CloudNode', 'ComposableNodeContainer', 'ContainerInstance', 'FogError',
    'FogMachine', 'FogROSLaunchDescription', 'Foxglove', 'GCPCloudInstance', 'JoinedMachine',
    'KubeInstance', 'LifecycleNode', 'MachineInterrupted', 'Node', 'Replicated', 'SSHInstance',
    'StreamTopic', 'cheapest', 'ec2_instance_type_selection', 'find_cheapest',
    'find_cheapest_ec2_instance_type', 'find_nearest_aws_region', 'nearest_aws_region_now',
    'region_ami_selection',
]
#: The public names of each module.
_NAMES = {
    'actions.cloud_group': 'CloudGroup',
    'actions.fog_machine': 'FogMachine',
    'actions.launch_description': 'FogROSLaunchDescription',
    'actions.nodes': 'CloudNode ComposableNodeContainer LifecycleNode Node',
    'describe.choices':
        'find_cheapest find_cheapest_ec2_instance_type find_nearest_aws_region '
        'nearest_aws_region_now',
    'describe.machines': 'CloudInstance ContainerInstance SSHInstance',
    'describe.machines_cloud':
        'AWSCloudInstance AzureCloudInstance CheapestInstance GCPCloudInstance KubeInstance '
        'cheapest',
    'errors': 'FogError',
    'runtime.interruption': 'MachineInterrupted',
}
_MODULES = {
    'Foxglove': 'fogros2_monitor.action',
    'JoinedMachine': 'fogros2_features.guests.machine',
    'Replicated': 'fogros2_features.replicas.action',
    'StreamTopic': 'fogros2_features.streams.entries',
    **{name: f'fogros2.{module}' for module, names in _NAMES.items() for name in names.split()}}
#: Modules that FogROS2 has in a package ``utils``: ``from fogros2 import region_ami_selection``.
_FORMERLY_UTILS = ('ec2_instance_type_selection', 'region_ami_selection')


def __getattr__(name: str) -> object:
    if name in _FORMERLY_UTILS:
        value = importlib.import_module('fogros2.describe.choices')
    elif name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
