# SPDX-License-Identifier: Apache-2.0
"""A description of what to launch, and where one may come from."""
from __future__ import annotations

import traceback
from typing import Any, Iterable, List, Optional, Tuple, TYPE_CHECKING

import launch.logging

from ._base import Action, Entities, LaunchDescriptionEntity, SomeSubstitutionsType
from .launch_context import LaunchContext
from .utilities import normalize_to_list_of_substitutions, perform_substitutions

if TYPE_CHECKING:
    from .actions import DeclareLaunchArgument


class LaunchDescription(LaunchDescriptionEntity):
    """Entities that are visited in order."""

    def __init__(
        self, initial_entities: Optional[Iterable[LaunchDescriptionEntity]] = None, *,
        deprecated_reason: Optional[str] = None
    ) -> None:
        self.__entities = list(initial_entities) if initial_entities is not None else []
        self.__deprecated_reason = deprecated_reason

    def visit(self, context: LaunchContext) -> Optional[Entities]:
        if self.deprecated:
            path = context.get_locals_as_dict().get('current_launch_file_path')
            what = 'deprecated launch description' if path is None else (
                f'launch file [{path}] is deprecated')
            launch.logging.get_logger().warning(f'{what}: {self.__deprecated_reason}')
        return self.__entities

    def describe_sub_entities(self) -> Entities:
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
    ) -> List[Tuple[DeclareLaunchArgument, Optional[List[Any]]]]:
        """Return the arguments, each with the includes on the way to it."""
        from .actions import (
            DeclareLaunchArgument,
            IncludeLaunchDescription,
            ResetLaunchConfigurations,
        )
        found: List[Tuple[DeclareLaunchArgument, Optional[List[Any]]]] = []

        def collect(
            entities: Iterable[LaunchDescriptionEntity], conditional: bool,
            includes: Optional[List[Any]]
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
    def entities(self) -> Entities:
        return self.__entities

    def add_entity(self, entity: LaunchDescriptionEntity) -> None:
        self.__entities.append(entity)

    def add_action(self, action: Action) -> None:
        self.add_entity(action)

    @property
    def deprecated(self) -> bool:
        return self.__deprecated_reason is not None

    @property
    def deprecated_reason(self) -> Optional[str]:
        return self.__deprecated_reason


class LaunchDescriptionSource:
    """A launch description, or the location to load it from by the method described."""

    def __init__(
        self, launch_description: Optional[LaunchDescription] = None,
        location: SomeSubstitutionsType = '<string>',
        method: str = 'unspecified mechanism from a script'
    ) -> None:
        self.__launch_description = launch_description
        self.__expanded_location: Optional[str] = None
        self.__location = normalize_to_list_of_substitutions(location)
        self.method = method
        self.__logger = launch.logging.get_logger(__name__)

    def try_get_launch_description_without_context(self) -> Optional[LaunchDescription]:
        """Return the description, or None where loading it fails without a context."""
        if self.__launch_description is not None:
            return self.__launch_description
        try:
            return self._get_launch_description(
                perform_substitutions(LaunchContext(), self.__location))
        except Exception as exc:  # noqa: BLE001 - A launch file can raise anything.
            self.__logger.debug(traceback.format_exc())
            self.__logger.debug(f'Failed to load the launch file without a context: {exc}')
        return None

    def get_launch_description(self, context: LaunchContext) -> LaunchDescription:
        """Return the description, loaded once."""
        if self.__expanded_location is None:
            self.__expanded_location = perform_substitutions(context, self.__location)
        if self.__launch_description is None:
            self.__launch_description = self._get_launch_description(self.__expanded_location)
        return self.__launch_description

    def _get_launch_description(self, location: str) -> LaunchDescription:
        raise RuntimeError(
            'LaunchDescriptionSource.get_launch_description(): '
            'called without launch description being set')

    @property
    def location(self) -> str:
        if self.__expanded_location is None:
            return ' + '.join(str(sub) for sub in self.__location)
        return self.__expanded_location
