# SPDX-License-Identifier: Apache-2.0
"""
Run nodes of a ROS 2 launch file on machines in the cloud, created at launch.

The public names for launch files are here, also those of features, which are entry points in the
group ``fogros2.public``. Each is imported at its first use: ``import fogros2`` alone loads neither
launch nor an SDK.
"""

from __future__ import annotations

import importlib.util
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from fogros2.actions.cloud_group import CloudGroup
    from fogros2.actions.fog_machine import FogMachine
    from fogros2.actions.launch_description import FogROSLaunchDescription
    from fogros2.actions.nodes import CloudNode, ComposableNodeContainer, LifecycleNode, Node
    from fogros2.describe.choices import find_nearest_aws_region, nearest_aws_region_now
    from fogros2.describe.machines import (
        CloudInstance,
        ContainerInstance,
        SSHInstance,
    )
    from fogros2.describe.machines_cloud import (
        AWSCloudInstance,
        AzureCloudInstance,
        GCPCloudInstance,
        KubeInstance,
    )
    from fogros2.errors import FogError
    from fogros2.runtime.interruption import MachineInterrupted

    # written out for type checkers, which do not run the module
    __all__ = [
        'AWSCloudInstance', 'AzureCloudInstance', 'CloudGroup', 'CloudInstance', 'CloudNode',
        'ComposableNodeContainer', 'ContainerInstance', 'FogError',
        'FogMachine', 'FogROSLaunchDescription', 'GCPCloudInstance', 'KubeInstance',
        'LifecycleNode', 'MachineInterrupted', 'Node', 'SSHInstance', 'find_nearest_aws_region',
        'nearest_aws_region_now',
    ]

#: The public names of each module.
_NAMES = {
    'actions.cloud_group': 'CloudGroup',
    'actions.fog_machine': 'FogMachine',
    'actions.launch_description': 'FogROSLaunchDescription',
    'actions.nodes': 'CloudNode ComposableNodeContainer LifecycleNode Node',
    'describe.choices': 'find_nearest_aws_region nearest_aws_region_now',
    'describe.machines': 'CloudInstance ContainerInstance SSHInstance',
    'describe.machines_cloud':
        'AWSCloudInstance AzureCloudInstance GCPCloudInstance KubeInstance',
    'errors': 'FogError',
    'runtime.interruption': 'MachineInterrupted',
}
_MODULES = {
    name: f'fogros2.{module}' for module, names in _NAMES.items() for name in names.split()}
#: Module that FogROS2 has in a package ``utils``: ``from fogros2 import region_ami_selection``.
_FORMERLY_UTILS = 'region_ami_selection'
_GROUP = 'fogros2.public'


def __getattr__(name: str) -> Any:
    value: Any
    if name == _FORMERLY_UTILS:
        value = importlib.import_module('fogros2.describe.choices')
    elif name in _MODULES:
        value = getattr(importlib.import_module(_MODULES[name]), name)
    elif name == '__all__':
        value = [*_MODULES, _FORMERLY_UTILS, *_plugins().names(_GROUP)]
    elif not importlib.util.find_spec(f'fogros2.{name}') and name in _plugins().names(_GROUP):
        value = _plugins().load(_GROUP, name)
    else:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    globals()[name] = value
    return value


def _plugins() -> Any:
    """Return the module, which small copies of the package do without."""
    return importlib.import_module('fogros2.plugin_system')


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__('__all__')})
