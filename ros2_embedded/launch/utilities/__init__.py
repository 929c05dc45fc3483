# SPDX-License-Identifier: Apache-2.0
"""Helpers that launch shares with those who extend it."""
from __future__ import annotations

import asyncio
import collections.abc
import inspect
from typing import Any, cast, Iterable, List, Optional, Tuple, TYPE_CHECKING, Union

from .._aliases import alias_submodules
from .._base import (
    Entities,
    LaunchDescriptionEntity,
    SomeEntitiesType,
    SomeSubstitutionsType,
    Substitution,
)
from .signal_management import AsyncSafeSignalManager

if TYPE_CHECKING:
    from ..launch_context import LaunchContext

__all__ = [
    'is_a', 'is_a_subclass', 'isclassinstance', 'ensure_argument_type', 'perform_substitutions',
    'AsyncSafeSignalManager', 'normalize_to_list_of_substitutions',
    'normalize_to_list_of_entities', 'visit_all_entities_and_collect_futures']


def isclassinstance(obj: object) -> bool:
    return hasattr(obj, '__class__')


def is_a(obj: object, entity_type: type) -> bool:
    if not inspect.isclass(entity_type):
        raise RuntimeError(f"entity_type '{obj}' is not a class")
    return isinstance(obj, entity_type)


def is_a_subclass(obj: object, entity_type: type) -> bool:
    """Say whether the object is an instance, or a subclass, of the class."""
    return is_a(obj, entity_type) or (inspect.isclass(obj) and issubclass(obj, entity_type))


def ensure_argument_type(
    argument: object, types: Union[type, Iterable[type]], argument_name: str,
    caller: Optional[str] = None
) -> None:
    """
    Refuse an argument of a wrong type.

    :raises TypeError: naming the caller, the argument and what was expected.
    """
    def check(value: object, allowed: Tuple[type, ...], who: str, name: str) -> None:
        if not isinstance(value, allowed):
            expected = ', '.join(str(one) for one in allowed)
            raise TypeError(
                f"{who}xpected '{name}' to be one of [{expected}], but got '{value}' of type "
                f"'{type(value)}'")

    myself = "'ensure_argument_type()' e"
    check(types, (type, collections.abc.Iterable), myself, 'types')
    check(argument_name, (str,), myself, 'argument_name')
    check(caller, (str, type(None)), myself, 'caller')
    check(argument, (types,) if isinstance(types, type) else tuple(types),
          f"'{caller}' e" if caller else 'E', argument_name)


def normalize_to_list_of_entities(entities: Iterable[SomeEntitiesType]) -> Entities:
    """Return the entities with iterables among them laid out flat, one level deep."""
    flat: Entities = []
    for entity in entities:
        flat.extend([entity] if isinstance(entity, LaunchDescriptionEntity) else entity)
    return flat


def normalize_to_list_of_substitutions(subs: SomeSubstitutionsType) -> List[Substitution]:
    """
    Return substitutions, texts as TextSubstitution.

    :raises TypeError: for an item that is neither.
    """
    from ..substitutions import TextSubstitution
    if isinstance(subs, str):
        return [TextSubstitution(text=subs)]
    if is_a_subclass(subs, Substitution):
        return [cast(Substitution, subs)]
    normalized: List[Substitution] = []
    for item in cast(Iterable[Union[str, Substitution]], subs):
        if isinstance(item, str):
            item = TextSubstitution(text=item)
        elif not isinstance(item, Substitution):
            raise TypeError(
                f"Failed to normalize given item of type '{type(item)}', when only 'str' or "
                "'launch.Substitution' were expected.")
        normalized.append(item)
    return normalized


def perform_substitutions(context: LaunchContext, subs: Iterable[Substitution]) -> str:
    return ''.join([context.perform_substitution(sub) for sub in subs])


def visit_all_entities_and_collect_futures(
    entity: LaunchDescriptionEntity, context: LaunchContext
) -> List[Tuple[LaunchDescriptionEntity, asyncio.Future[Any]]]:
    """Visit the entity and, depth first, all that it yields; return what is to be waited for."""
    sub_entities = entity.visit(context)
    future = entity.get_asyncio_future()
    futures = [] if future is None else [(entity, future)]
    for sub_entity in sub_entities or ():
        futures += visit_all_entities_and_collect_futures(sub_entity, context)
    return futures


alias_submodules(
    __name__, (), class_tools_impl=('is_a', 'is_a_subclass', 'isclassinstance'),
    **{f'{name}_impl': (name,) for name in __all__[3:] if name.islower()})
