# SPDX-License-Identifier: Apache-2.0
"""A description of what to launch."""
from __future__ import annotations

from typing import Iterable, List, Optional, Tuple, TYPE_CHECKING

import launch.logging

from .action import Action
from .launch_context import LaunchContext
from .launch_description_entity import LaunchDescriptionEntity

if TYPE_CHECKING:
    from .actions import DeclareLaunchArgument, IncludeLaunchDescription


class LaunchDescription(LaunchDescriptionEntity):
    """
    Entities that are visited in order.

    :param deprecated_reason: if given, a warning when the description is visited.
    """

    def __init__(
        self, initial_entities: Optional[Iterable[LaunchDescriptionEntity]] = None, *,
        deprecated_reason: Optional[str] = None
    ) -> None:
        self.__entities = list(initial_entities) if initial_entities is not None else []
        self.__deprecated_reason = deprecated_reason

    def visit(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        if self.deprecated:
            path = context.get_locals_as_dict().get('current_launch_file_path')
            what = 'deprecated launch description' if path is None else (
                f'launch file [{path}] is deprecated')
            launch.logging.get_logger().warning(f'{what}: {self.__deprecated_reason}')
        return self.__entities

    def describe_sub_entities(self) -> List[LaunchDescriptionEntity]:
        return self.__entities

    def get_launch_arguments(
        self, conditional_inclusion: bool = False
    ) -> List[DeclareLaunchArgument]:
        """Return the arguments declared here and below, the first of each name."""
        pairs = self.get_launch_arguments_with_include_launch_description_actions(
            conditional_inclusion)
        return [argument for argument, _ in pairs]

    def get_launch_arguments_with_include_launch_description_actions(
        self, conditional_inclusion: bool = False
    ) -> List[Tuple[DeclareLaunchArgument, Optional[List[IncludeLaunchDescription]]]]:
        """Return the arguments, each with the includes on the way to it."""
        from .actions import (
            DeclareLaunchArgument,
            IncludeLaunchDescription,
            ResetLaunchConfigurations,
        )
        Includes = Optional[List[IncludeLaunchDescription]]
        found: List[Tuple[DeclareLaunchArgument, Includes]] = []

        def collect(
            entities: Iterable[LaunchDescriptionEntity], conditional: bool, includes: Includes
        ) -> None:
            for entity in entities:
                if isinstance(entity, DeclareLaunchArgument):
                    if any(entity.name == argument.name for argument, _ in found):
                        continue
                    entity._conditionally_included = conditional or entity.condition is not None
                    found.append((entity, includes))
                if isinstance(entity, ResetLaunchConfigurations):
                    # What follows can't see the arguments of this launch.
                    return
                inner = includes
                if isinstance(entity, IncludeLaunchDescription):
                    inner = [*(includes or ()), entity]
                collect(entity.describe_sub_entities(), False, inner)
                for _, conditional_entities in entity.describe_conditional_sub_entities():
                    collect(conditional_entities, True, inner)

        collect(self.entities, conditional_inclusion, None)
        return found

    @property
    def entities(self) -> List[LaunchDescriptionEntity]:
        """The entities, in order."""
        return self.__entities

    def add_entity(self, entity: LaunchDescriptionEntity) -> None:
        """Add an entity at the end."""
        self.__entities.append(entity)

    def add_action(self, action: Action) -> None:
        """Add an action at the end."""
        self.add_entity(action)

    @property
    def deprecated(self) -> bool:
        """Whether a warning comes when the description is visited."""
        return self.__deprecated_reason is not None

    @property
    def deprecated_reason(self) -> Optional[str]:
        """The warning's text."""
        return self.__deprecated_reason
