# SPDX-License-Identifier: Apache-2.0
"""Helpers that launch shares with those who extend it."""
from __future__ import annotations

import asyncio
import collections.abc
import inspect
from typing import Any, cast, Iterable, List, Optional, Tuple, TYPE_CHECKING, Union

from .._aliases import alias_submodules
from ..launch_description_entity import LaunchDescriptionEntity
from ..some_entities_type import SomeEntitiesType
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from .signal_management import AsyncSafeSignalManager

if TYPE_CHECKING:
    from ..launch_context import LaunchContext

__all__ = [
    'is_a',
    'is_a_subclass',
    'isclassinstance',
    'ensure_argument_type',
    'perform_substitutions',
    'AsyncSafeSignalManager',
    'normalize_to_list_of_substitutions',
    'normalize_to_list_of_entities',
    'visit_all_entities_and_collect_futures',
]


def isclassinstance(obj: object) -> bool:
    """Say whether it is an object of some class."""
    return hasattr(obj, '__class__')


def is_a(obj: object, entity_type: type) -> bool:
    """
    Say whether the object is an instance of the class.

    :raises RuntimeError: if ``entity_type`` isn't a class.
    """
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
    def refuse(who: str, name: str, expected: str, value: object) -> None:
        raise TypeError(
            f"{who}xpected '{name}' to be one of [{expected}], but got '{value}' of type "
            f"'{type(value)}'")

    myself = "'ensure_argument_type()' e"
    if not isinstance(types, (type, collections.abc.Iterable)):
        refuse(myself, 'types', 'type, collections.abc.Iterable of type', types)
    if not isinstance(argument_name, str):
        refuse(myself, 'argument_name', 'str', argument_name)
    if caller is not None and not isinstance(caller, str):
        refuse(myself, 'caller', 'str, None', caller)
    allowed = (types,) if isinstance(types, type) else tuple(types)
    if not isinstance(argument, allowed):
        refuse(f"'{caller}' e" if caller else 'E', argument_name,
               ', '.join(str(one) for one in allowed), argument)


def normalize_to_list_of_entities(
    entities: Iterable[SomeEntitiesType]
) -> List[LaunchDescriptionEntity]:
    """Return the entities with iterables among them laid out flat, one level deep."""
    flat: List[LaunchDescriptionEntity] = []
    for entity in entities:
        if isinstance(entity, LaunchDescriptionEntity):
            flat.append(entity)
        else:
            flat.extend(entity)
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
    """Return the substitutions' texts, joined."""
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


alias_submodules(__name__, (), {
    'class_tools_impl': ('is_a', 'is_a_subclass', 'isclassinstance'),
    'ensure_argument_type_impl': ('ensure_argument_type',),
    'normalize_to_list_of_entities_impl': ('normalize_to_list_of_entities',),
    'normalize_to_list_of_substitutions_impl': ('normalize_to_list_of_substitutions',),
    'perform_substitutions_impl': ('perform_substitutions',),
    'visit_all_entities_and_collect_futures_impl': ('visit_all_entities_and_collect_futures',),
})
