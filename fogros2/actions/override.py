# SPDX-License-Identifier: Apache-2.0
"""Run machines of some content elsewhere than the launch file says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Optional, TYPE_CHECKING

from launch import Action, LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import IncludeLaunchDescription, OpaqueFunction

from fogros2.actions.launch_description import cloud_entities, holder
from fogros2.describe.overrides import Overrides
from fogros2.launch_internals.wrapping import everything, wrap
from fogros2.runtime.coordinator import Coordinator

if TYPE_CHECKING:
    from fogros2.describe.machines import SomeMachine


class OverrideMachines(Action):
    """
    Run machines of some content elsewhere.

    :param overrides: the machines, and where they run.
    :param entities: the content, such as an included launch file.
    """

    def __init__(
        self, overrides: Overrides, entities: Sequence[LaunchDescriptionEntity],
    ) -> None:
        super().__init__()
        self._overrides = overrides
        self._entities = list(entities)

    def get_sub_entities(self) -> list[LaunchDescriptionEntity]:
        """Return the content, because launch inspects sub-entities before execution."""
        return list(self._entities)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action: find the machines in the content, and return the content."""
        coordinator = Coordinator.of(context)
        machines: list[SomeMachine] = []
        _load(self._entities, context)
        whole = _look_through(self._entities, machines)
        coordinator.override(self._overrides, machines, whole=whole)
        return wrap(self._entities, _mention)


def _load(entities: Iterable[LaunchDescriptionEntity], context: LaunchContext) -> None:
    """Load included launch files permanently; launch's inspection discards what it loads."""
    for entity in entities:
        if isinstance(entity, LaunchDescription):
            _load(entity.entities, context)
        elif isinstance(entity, IncludeLaunchDescription):
            entity.launch_description_source.get_launch_description(context)


def _look_through(
    entities: Iterable[LaunchDescriptionEntity], machines: list[SomeMachine],
) -> bool:
    """
    Collect the machines of entities, at any depth, in included files too.

    :return: True if these are all; False if a function or an unread file may add machines.
    """
    whole = True
    for entity in everything(entities, included=True):
        member = holder(entity)
        if member is not None and member.machine is not None:
            machines.append(member.machine)
        if isinstance(entity, OpaqueFunction) or (
                isinstance(entity, IncludeLaunchDescription)
                and not entity.describe_sub_entities()):
            whole = False
    return whole


def _mention(entity: LaunchDescriptionEntity, context: LaunchContext) -> None:
    """Remember the machines of an entity, also those that a timer or an event adds."""
    for member, _ in cloud_entities([entity]):
        Coordinator.of(context).mention(member.machine)
