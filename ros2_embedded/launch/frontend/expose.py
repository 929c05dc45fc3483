# SPDX-License-Identifier: Apache-2.0
"""The actions and substitutions that launch files can use, by name."""
from __future__ import annotations

import functools
import inspect
from typing import Any, Callable, Dict, Iterable, Optional, TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from .._base import Action, SomeSubstitutionsType, Substitution
    from .parser import Parser
    from .type_utils import Entity

T = TypeVar('T')

action_parse_methods: Dict[str, Callable[..., Any]] = {}
substitution_parse_methods: Dict[str, Callable[..., Any]] = {}


def instantiate_action(entity: Entity, parser: Parser) -> Action:
    if entity.type_name not in action_parse_methods:
        raise RuntimeError(f'Unrecognized entity of the type: {entity.type_name}')
    action_type, kwargs = action_parse_methods[entity.type_name](entity, parser)
    action: Action = action_type(**kwargs)
    return action


def instantiate_substitution(
    type_name: str, args: Optional[Iterable[SomeSubstitutionsType]] = None
) -> Substitution:
    if type_name not in substitution_parse_methods:
        raise RuntimeError(f'Unknown substitution: {type_name}')
    substitution_type, kwargs = substitution_parse_methods[type_name](args or [])
    # Substitutions of any number of arguments can't take them by keyword.
    positional = kwargs.pop('args', ())
    substitution: Substitution = substitution_type(*positional, **kwargs)
    return substitution


def _expose(name: str, methods: Dict[str, Any], kind: str) -> Callable[[T], T]:
    def decorate(exposed: T) -> T:
        parse: Any = exposed
        if inspect.isclass(exposed):
            parse = getattr(exposed, 'parse', None)
            if not inspect.ismethod(parse):
                raise RuntimeError(
                    "Did not find a class method called 'parse' in the class being decorated.")
        elif not inspect.isfunction(exposed):
            raise RuntimeError(
                f'Exposed {kind} parser for {name} is not a callable or a class containing a '
                'parse method')
        if name in methods and getattr(methods[name], '__wrapped__', methods[name]) != parse:
            raise RuntimeError(f'Two {kind} parsing methods exposed with the same name: [{name}].')

        @functools.wraps(parse)
        def parse_completely(entity: Entity, parser: Parser) -> Any:
            parsed = parse(entity, parser)
            entity.assert_entity_completely_parsed()
            return parsed

        methods[name] = parse_completely if kind == 'action' else parse
        return exposed
    return decorate


def expose_substitution(name: str) -> Callable[[T], T]:
    """Make a class with a class method ``parse``, or a function, usable as ``$(name ...)``."""
    return _expose(name, substitution_parse_methods, 'substitution')


def expose_action(name: str) -> Callable[[T], T]:
    """Make a class with a class method ``parse``, or a function, usable as ``<name .../>``."""
    return _expose(name, action_parse_methods, 'action')
