# SPDX-License-Identifier: Apache-2.0
"""Helpers that launch shares with those who extend it."""
from __future__ import annotations

import asyncio
import inspect
from typing import Any, Iterable

from .._base import (
    Entities,
    LaunchDescriptionEntity,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)
from ..launch_context import LaunchContext
from .signal_management import AsyncSafeSignalManager

__all__ = [
    'AsyncSafeSignalManager', 'ensure_argument_type', 'is_a_subclass',
    'normalize_to_list_of_entities', 'normalize_to_list_of_substitutions',
    'perform_substitutions', 'visit_all_entities_and_collect_futures']


def is_a_subclass(obj: object, entity_type: type) -> bool:
    """Say whether the object is an instance, or a subclass, of the class."""
    return isinstance(obj, entity_type) or (inspect.isclass(obj) and issubclass(obj, entity_type))


def ensure_argument_type(
    argument: object, types: type | Iterable[type], argument_name: str, caller: str | None = None
) -> None:
    """
    Refuse an argument of a wrong type.

    :raises TypeError: naming the caller, the argument and what was expected.
    """
    allowed = (types,) if isinstance(types, type) else tuple(types)
    if not isinstance(argument, allowed):
        who = f"'{caller}' e" if caller else 'E'
        raise TypeError(
            f"{who}xpected '{argument_name}' to be one of [{', '.join(map(str, allowed))}], but "
            f"got '{argument}' of type '{type(argument)}'")


def normalize_to_list_of_entities(entities: Iterable[Any]) -> Entities:
    """Return the entities with iterables among them laid out flat, one level deep."""
    flat: Entities = []
    for entity in entities:
        flat.extend([entity] if isinstance(entity, LaunchDescriptionEntity) else entity)
    return flat


def visit_all_entities_and_collect_futures(
    entity: LaunchDescriptionEntity, context: LaunchContext
) -> list[tuple[LaunchDescriptionEntity, asyncio.Future[Any]]]:
    """Visit the entity and, depth first, all that it yields; return what is to be waited for."""
    sub_entities = entity.visit(context)
    future = entity.get_asyncio_future()
    futures = [] if future is None else [(entity, future)]
    for sub_entity in sub_entities or ():
        futures += visit_all_entities_and_collect_futures(sub_entity, context)
    return futures
