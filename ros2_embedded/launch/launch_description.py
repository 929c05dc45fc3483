# SPDX-License-Identifier: Apache-2.0
"""A description of what to launch, and where one may come from."""
from __future__ import annotations

from typing import Any, Iterable

import launch.logging

from ._base import (
    Entities,
    LaunchDescriptionEntity,
    normalize_to_list_of_substitutions,
    perform_substitutions,
    SomeSubstitutionsType,
)
from .launch_context import LaunchContext


class LaunchDescription(LaunchDescriptionEntity):
    """Entities that are visited in order."""

    def __init__(
        self, initial_entities: Iterable[LaunchDescriptionEntity] | None = None, *,
        deprecated_reason: str | None = None
    ) -> None:
        self.entities = list(initial_entities or ())
        self.deprecated = deprecated_reason is not None
        self.deprecated_reason = deprecated_reason

    def visit(self, context: LaunchContext) -> Entities | None:
        if self.deprecated:
            path = context.get_locals_as_dict().get('current_launch_file_path')
            what = f'launch file [{path}] is deprecated' if path else (
                'deprecated launch description')
            launch.logging.get_logger().warning(f'{what}: {self.deprecated_reason}')
        return self.entities

    def describe_sub_entities(self) -> Entities:
        return self.entities

    def get_launch_arguments(self) -> list[Any]:
        """Return the arguments declared here and below, the first of each name."""
        pairs = self.get_launch_arguments_with_include_launch_description_actions()
        return [argument for argument, _ in pairs]

    def get_launch_arguments_with_include_launch_description_actions(
        self
    ) -> list[tuple[Any, list[Any]]]:
        """Return the arguments, each with the includes on the way to it."""
        found: list[tuple[Any, list[Any]]] = []

        def collect(
            entities: Iterable[LaunchDescriptionEntity], conditional: bool, includes: list[Any]
        ) -> None:
            entity: Any
            for entity in entities:
                role = getattr(entity, '_role', '')
                if role == 'argument':
                    if any(entity.name == argument.name for argument, _ in found):
                        continue
                    entity._conditionally_included = conditional or entity.condition is not None
                    found.append((entity, includes))
                if role == 'reset':
                    # What follows can't see the arguments of this launch.
                    return
                inner = [*includes, entity] if role == 'include' else includes
                collect(entity.describe_sub_entities(), False, inner)
                for _, conditional_entities in entity.describe_conditional_sub_entities():
                    collect(conditional_entities, True, inner)

        collect(self.entities, False, [])
        return found

    def add_entity(self, entity: LaunchDescriptionEntity) -> None:
        self.entities.append(entity)

    add_action = add_entity


class _NoLaunch(LaunchContext):
    """A context for descriptions, in which no substitution runs a command or an expression."""

    def perform_substitution(self, substitution: Any) -> str:
        if substitution._runs_code:
            raise RuntimeError(f'{substitution.describe()} runs at launch')
        return super().perform_substitution(substitution)


class LaunchDescriptionSource:
    """A launch description, or the location to load it from."""

    def __init__(
        self, launch_description: LaunchDescription | None = None,
        location: SomeSubstitutionsType = '<string>'
    ) -> None:
        self.__launch_description = launch_description
        self.__expanded_location: str | None = None
        self.__location = normalize_to_list_of_substitutions(location)
        self.__logger = launch.logging.get_logger(__name__)

    def try_get_launch_description_without_context(self) -> LaunchDescription | None:
        """Return the description, or None where loading it fails without a context."""
        if self.__launch_description is not None:
            return self.__launch_description
        try:
            return self._get_launch_description(
                perform_substitutions(_NoLaunch(), self.__location))
        except Exception as exc:
            self.__logger.debug(
                f'Failed to load the launch file without a context: {exc}', exc_info=True)
        return None

    def get_launch_description(self, context: LaunchContext) -> LaunchDescription:
        """Return the description, loaded once."""
        if self.__expanded_location is None:
            self.__expanded_location = perform_substitutions(context, self.__location)
        if self.__launch_description is None:
            self.__launch_description = self._get_launch_description(self.__expanded_location)
        return self.__launch_description

    def _get_launch_description(self, location: str) -> LaunchDescription:
        raise RuntimeError('LaunchDescriptionSource.get_launch_description(): '
                           'called without launch description being set')

    @property
    def location(self) -> str:
        if self.__expanded_location is None:
            return ' + '.join(str(sub) for sub in self.__location)
        return self.__expanded_location
