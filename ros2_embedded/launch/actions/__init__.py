# SPDX-License-Identifier: Apache-2.0
"""What a launch can do."""
from ._environment import AppendEnvironmentVariable, DeclareLaunchArgument, PopEnvironment
from ._environment import PopLaunchConfigurations, PushEnvironment, PushLaunchConfigurations
from ._environment import ResetEnvironment, ResetLaunchConfigurations, SetEnvironmentVariable
from ._environment import SetLaunchConfiguration, UnsetEnvironmentVariable
from ._environment import UnsetLaunchConfiguration
from ._simple import EmitEvent, LogInfo, OpaqueCoroutine, OpaqueFunction, RegisterEventHandler
from ._simple import Shutdown, UnregisterEventHandler
from ._structure import GroupAction, IncludeLaunchDescription, TimerAction
from .execute_local import ExecuteLocal
from .execute_process import ExecuteProcess
from .._aliases import alias_submodules, missing

__all__ = [
    'AppendEnvironmentVariable',
    'DeclareLaunchArgument',
    'EmitEvent',
    'ExecuteLocal',
    'ExecuteProcess',
    'GroupAction',
    'IncludeLaunchDescription',
    'LogInfo',
    'OpaqueCoroutine',
    'OpaqueFunction',
    'PopEnvironment',
    'PopLaunchConfigurations',
    'PushEnvironment',
    'PushLaunchConfigurations',
    'ResetEnvironment',
    'ResetLaunchConfigurations',
    'RegisterEventHandler',
    'SetEnvironmentVariable',
    'SetLaunchConfiguration',
    'Shutdown',
    'TimerAction',
    'UnregisterEventHandler',
    'UnsetEnvironmentVariable',
    'UnsetLaunchConfiguration',
]

alias_submodules(__name__, __all__, {'shutdown_action': ('Shutdown',)})


def __getattr__(name: str) -> object:
    missing(__name__, name)
