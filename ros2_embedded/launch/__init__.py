# SPDX-License-Identifier: Apache-2.0
"""Starts, watches and stops processes as a launch description says: ROS 2 Jazzy's API."""
from . import (
    actions,
    conditions,
    descriptions,
    event_handlers,
    events,
    frontend,
    launch_description_sources,
    logging,
    substitutions,
)
from ._aliases import alias_submodules
from ._base import (
    Action,
    BaseEventHandler,
    Condition,
    Event,
    EventHandler,
    InvalidLaunchFileError,
    LaunchDescriptionEntity,
    SomeEntitiesType,
    SomeEntitiesType_types_tuple,
    SomeSubstitutionsType,
    SomeSubstitutionsType_types_tuple,
    Substitution,
)
from .launch_context import LaunchContext
from .launch_description import LaunchDescription, LaunchDescriptionSource
from .launch_introspector import LaunchIntrospector
from .launch_service import LaunchService

__all__ = [
    'actions', 'conditions', 'descriptions', 'event_handlers', 'events', 'frontend',
    'launch_description_sources', 'logging', 'substitutions', 'Action', 'BaseEventHandler',
    'Condition', 'Event', 'EventHandler', 'InvalidLaunchFileError', 'LaunchContext',
    'LaunchDescription', 'LaunchDescriptionEntity', 'LaunchDescriptionSource',
    'LaunchIntrospector', 'LaunchService', 'SomeEntitiesType', 'SomeEntitiesType_types_tuple',
    'SomeSubstitutionsType', 'SomeSubstitutionsType_types_tuple', 'Substitution']

alias_submodules(
    __name__, ('Action', 'Condition', 'Event', 'InvalidLaunchFileError',
               'LaunchDescriptionEntity', 'LaunchDescriptionSource', 'Substitution'),
    event_handler=('BaseEventHandler', 'EventHandler'),
    some_entities_type=('SomeEntitiesType', 'SomeEntitiesType_types_tuple'),
    some_substitutions_type=('SomeSubstitutionsType', 'SomeSubstitutionsType_types_tuple'))
