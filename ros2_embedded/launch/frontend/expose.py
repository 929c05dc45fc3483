# SPDX-License-Identifier: Apache-2.0
"""The actions and substitutions that launch files can use, by name."""
from __future__ import annotations

import functools
import inspect
from typing import Any, Callable, Iterable, TypeVar

from .._base import Action, SomeSubstitutionsType, Substitution

T = TypeVar('T')

action_parse_methods: dict[str, Callable[..., Any]] = {}
substitution_parse_methods: dict[str, Callable[..., Any]] = {}
#: What ROS 2 has and this hasn't.
_LACKING = {'action': 'ros_timer set_use_sim_time', 'substitution':
            'all anon any if launch_log_dir log_dir param'}


def _parse(kind: str, methods: dict[str, Any], name: str, unknown: str, *args: Any) -> Any:
    if name in methods:
        return methods[name](*args)
    if name in _LACKING[kind].split():
        from embedded_default.lacking import NotEmbeddedError
        raise NotEmbeddedError(f"the {kind} '{name}' in launch files")
    raise RuntimeError(f'{unknown}: {name}')


def instantiate_action(entity: Any, parser: Any) -> Action:
    action_type, kwargs = _parse(
        'action', action_parse_methods, entity.type_name, 'Unrecognized entity of the type',
        entity, parser)
    action: Action = action_type(**kwargs)
    return action


def instantiate_substitution(
    type_name: str, args: Iterable[SomeSubstitutionsType] | None = None
) -> Substitution:
    substitution_type, kwargs = _parse(
        'substitution', substitution_parse_methods, type_name, 'Unknown substitution', args or [])
    substitution: Substitution = substitution_type(**kwargs)
    return substitution


def _expose(name: str, methods: dict[str, Any], kind: str) -> Callable[[T], T]:
    def decorate(exposed: T) -> T:
        parse: Any = exposed
        if inspect.isclass(exposed):
            parse = getattr(exposed, 'parse', None)
            if not inspect.ismethod(parse):
                raise RuntimeError(
                    "Did not find a class method called 'parse' in the class being decorated.")
        if name in methods and getattr(methods[name], '__wrapped__', methods[name]) != parse:
            raise RuntimeError(f'Two {kind} parsing methods exposed with the same name: [{name}].')

        @functools.wraps(parse)
        def parse_completely(entity: Any, parser: Any) -> Any:
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
