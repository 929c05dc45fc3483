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
    from fogros2.actions.cloud_group import CloudGroup as CloudGroup
    from fogros2.actions.fog_machine import FogMachine as FogMachine
    from fogros2.actions.foxglove import Foxglove as Foxglove
    from fogros2.actions.launch_description import (
        FogROSLaunchDescription as FogROSLaunchDescription,
    )
    from fogros2.actions.nodes import (
        CloudNode as CloudNode,
    )
    from fogros2.actions.nodes import (
        ComposableNodeContainer as ComposableNodeContainer,
    )
    from fogros2.actions.nodes import (
        LifecycleNode as LifecycleNode,
    )
    from fogros2.actions.nodes import (
        Node as Node,
    )
    from fogros2.actions.replicated import Replicated as Replicated
    from fogros2.describe.choices import (
        find_cheapest as find_cheapest,
    )
    from fogros2.describe.choices import (
        find_cheapest_ec2_instance_type as find_cheapest_ec2_instance_type,
    )
    from fogros2.describe.choices import (
        find_nearest_aws_region as find_nearest_aws_region,
    )
    from fogros2.describe.choices import (
        nearest_aws_region_now as nearest_aws_region_now,
    )
    from fogros2.describe.machines import (
        CloudInstance as CloudInstance,
    )
    from fogros2.describe.machines import (
        ContainerInstance as ContainerInstance,
    )
    from fogros2.describe.machines import (
        JoinedMachine as JoinedMachine,
    )
    from fogros2.describe.machines import (
        SSHInstance as SSHInstance,
    )
    from fogros2.describe.machines_cloud import (
        AWSCloudInstance as AWSCloudInstance,
    )
    from fogros2.describe.machines_cloud import (
        AzureCloudInstance as AzureCloudInstance,
    )
    from fogros2.describe.machines_cloud import (
        cheapest as cheapest,
    )
    from fogros2.describe.machines_cloud import (
        CheapestInstance as CheapestInstance,
    )
    from fogros2.describe.machines_cloud import (
        GCPCloudInstance as GCPCloudInstance,
    )
    from fogros2.describe.machines_cloud import (
        KubeInstance as KubeInstance,
    )
    from fogros2.errors import FogError as FogError
    from fogros2.image_transport.streams import StreamTopic as StreamTopic
    from fogros2.runtime.interruption import MachineInterrupted as MachineInterrupted

#: The public names of each module.
_NAMES = {
    'actions.cloud_group': 'CloudGroup',
    'actions.fog_machine': 'FogMachine',
    'actions.foxglove': 'Foxglove',
    'actions.launch_description': 'FogROSLaunchDescription',
    'actions.nodes': 'CloudNode ComposableNodeContainer LifecycleNode Node',
    'actions.replicated': 'Replicated',
    'describe.choices':
        'find_cheapest find_cheapest_ec2_instance_type find_nearest_aws_region '
        'nearest_aws_region_now',
    'describe.machines': 'CloudInstance ContainerInstance JoinedMachine SSHInstance',
    'describe.machines_cloud':
        'AWSCloudInstance AzureCloudInstance CheapestInstance GCPCloudInstance KubeInstance '
        'cheapest',
    'errors': 'FogError',
    'image_transport.streams': 'StreamTopic',
    'runtime.interruption': 'MachineInterrupted',
}
_MODULES = {name: f'fogros2.{module}' for module, names in _NAMES.items()
            for name in names.split()}
#: Modules that FogROS2 has in a package ``utils``: ``from fogros2 import region_ami_selection``.
_FORMERLY_UTILS = ('ec2_instance_type_selection', 'region_ami_selection')
__all__ = [*_MODULES, *_FORMERLY_UTILS]  # noqa: PLE0604


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
