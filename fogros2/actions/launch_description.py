# SPDX-License-Identifier: Apache-2.0
"""FogROSLaunchDescription: a launch description that knows all of its machines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import functools
from typing import Any, get_args, Optional, Union

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    AppendEnvironmentVariable,
    DeclareLaunchArgument,
    ExecuteLocal,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    TimerAction,
    UnsetEnvironmentVariable,
    UnsetLaunchConfiguration,
)
from launch_ros.actions import (
    PushROSNamespace,
    SetParameter,
    SetParametersFromFile,
    SetRemap,
    SetROSLogDir,
)

from fogros2.actions.cloud_group import CloudGroup
from fogros2.actions.fog_machine import FogMachine
from fogros2.describe import features
from fogros2.describe.kinds import names_of, unknown
from fogros2.errors import ConfigurationError
from fogros2.launch_internals import private
from fogros2.launch_internals.wrapping import below, everything, wrap
from fogros2.model import RobotNodes
from fogros2.runtime import node_spec
from fogros2.runtime.coordinator import Coordinator, Planned
from fogros2.runtime.remote_process import remote_of, RemoteProcess

#: Actions that change what the values of a machine may depend on.
_SETTERS = (
    AppendEnvironmentVariable, DeclareLaunchArgument, SetEnvironmentVariable,
    SetLaunchConfiguration, UnsetEnvironmentVariable, UnsetLaunchConfiguration,
)
#: Entities that start nothing when they execute.
_SETTINGS = (
    *_SETTERS, FogMachine, LogInfo, PushROSNamespace, RegisterEventHandler, SetParameter,
    SetParametersFromFile, SetRemap, SetROSLogDir,
)


class FogROSLaunchDescription(LaunchDescription):
    """
    A :class:`launch.LaunchDescription` whose robot nodes wait for its cloud.

    :param robot_nodes: 'after_cloud' starts the robot's processes and timers when the machines
        are up and their nodes run; 'immediately' starts them at once. In both cases launch
        executes all actions in their order: only the start of a process waits.
    :param dds: the middleware of all nodes, such as 'fastdds'; replaces RMW_IMPLEMENTATION.
    :param lists: lists of features, as for Node, for every machine of the launch.
    """

    def __init__(
        self, initial_entities: Optional[Iterable[LaunchDescriptionEntity]] = None, *,
        deprecated_reason: Optional[str] = None, robot_nodes: RobotNodes = 'after_cloud',
        dds: Optional[str] = None, **lists: Any,
    ) -> None:
        self.lists = features.take_lists(lists)
        for name in lists:
            raise unknown('a FogROSLaunchDescription', name,
                          names_of(FogROSLaunchDescription) | features.node_lists().keys())
        super().__init__(initial_entities, deprecated_reason=deprecated_reason)
        if robot_nodes not in get_args(RobotNodes):
            raise ConfigurationError(
                f'robot_nodes={robot_nodes!r} is unknown', f'use one of {get_args(RobotNodes)}')
        self.robot_nodes = robot_nodes
        self.dds = dds

    def visit(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Visit the content; make its robot processes wait for the cloud."""
        entities = super().visit(context)
        if context.is_shutdown or entities is None:
            return entities
        coordinator = Coordinator.of(context)
        if self.dds is not None:
            coordinator.use_dds(self.dds)
        coordinator.parts.everywhere(
            self.lists, context.launch_configurations.get('ros_namespace', '/'))
        planned: list[Planned] = []
        for entity, certain in cloud_entities(self.entities):
            if isinstance(entity, FogMachine):
                # of several with the same name, the one whose condition holds registers itself
                coordinator.know(entity.machine if certain else None)
                continue
            coordinator.know(entity.machine)
            # items of a process that executes late are checked before a machine is created
            coordinator.parts.check(entity.lists)
            if certain:
                planned += _planned(entity)
        if planned:
            # the first cloud process may execute late, from a timer, but nodes here, launch's own
            # included, need the DDS settings before they start. Settings that come first, such as
            # ROS_DOMAIN_ID, have to be applied before that.
            first = next((number for number, entity in enumerate(entities)
                          if not isinstance(entity, _SETTINGS)), len(entities))
            settled = not any(
                _sets(entity) for number, entity in enumerate(entities)
                if number >= first or isinstance(entity, RegisterEventHandler))
            engage = OpaqueFunction(function=lambda context: coordinator.engage_for(
                planned, settled=settled))
            entities = [*entities[:first], engage, *entities[first:]]
        if self.robot_nodes == 'immediately':
            return entities
        coordinator.hold()
        return wrap(entities, functools.partial(_hold, coordinator))


def holder(
    entity: LaunchDescriptionEntity,
) -> Optional[Union[RemoteProcess, CloudGroup, FogMachine]]:
    """Return what has the machine of an entity, None for an entity without one."""
    return entity if isinstance(entity, (CloudGroup, FogMachine)) else remote_of(entity)


def _planned(entity: Union[RemoteProcess, CloudGroup]) -> Iterator[Planned]:
    """Yield the processes of an entity whose machine is known, or at least the machine."""
    if isinstance(entity, RemoteProcess):
        yield entity.planned
        return
    yield entity.machine, None
    for process in _processes(below(entity)):
        yield entity.machine, node_spec.program_of(process)


def _processes(
    several: Iterable[Iterable[LaunchDescriptionEntity]],
) -> Iterator[ExecuteLocal]:
    """Yield the processes without a condition and without a machine of their own, at any depth."""
    for entities in several:
        for entity in entities:
            if getattr(entity, 'condition', None) is not None or holder(entity):
                continue
            if isinstance(entity, ExecuteLocal):
                yield entity
            elif not isinstance(entity, IncludeLaunchDescription):
                yield from _processes(below(entity))


def _sets(entity: LaunchDescriptionEntity) -> bool:
    """Return whether an entity, or one below it, sets what a machine's values may depend on."""
    return any(isinstance(one, _SETTERS) for one in everything([entity]))


def cloud_entities(
    entities: Iterable[LaunchDescriptionEntity], certain: bool = True,
) -> Iterator[tuple[Union[RemoteProcess, CloudGroup, FogMachine], bool]]:
    """
    Yield what has a machine, at any depth, without reading files.

    The flag is True if no condition precedes the entity: it executes, or an event can execute it.
    """
    for entity in entities:
        sure = certain and getattr(entity, 'condition', None) is None
        if (found := holder(entity)) is not None:
            yield found, sure
        if not isinstance(entity, IncludeLaunchDescription):
            for some in below(entity):
                yield from cloud_entities(some, sure)


def _hold(
    coordinator: Coordinator, entity: LaunchDescriptionEntity, context: LaunchContext,
) -> None:
    """Make a robot process or a timer wait until the cloud is up."""
    async def released() -> bool:
        # an outer CloudGroup may have sent it meanwhile: it is no longer a robot process
        return remote_of(entity) is not None or await coordinator.hold()

    if isinstance(entity, (ExecuteLocal, TimerAction)) and remote_of(entity) is None:
        private.delay_start(entity, released)
