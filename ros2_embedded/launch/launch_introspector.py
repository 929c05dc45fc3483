# SPDX-License-Identifier: Apache-2.0
"""Describes launch descriptions for humans."""
from __future__ import annotations

from typing import Any, Iterable, List, Tuple

from ._base import Action, LaunchDescriptionEntity, SomeSubstitutionsType
from .actions import EmitEvent, ExecuteProcess, LogInfo, RegisterEventHandler
from .launch_description import LaunchDescription
from .utilities import normalize_to_list_of_substitutions

Tree = Tuple[str, List[Any]]


def format_substitutions(substitutions: SomeSubstitutionsType) -> str:
    normalized = normalize_to_list_of_substitutions(substitutions)
    return ' + '.join(sub.describe() for sub in normalized)


def _describe(entity: LaunchDescriptionEntity) -> Tree:
    if isinstance(entity, LogInfo):
        return f'LogInfo({format_substitutions(entity.msg)})', []
    if isinstance(entity, EmitEvent):
        return f"EmitEvent(event='{entity.event.name}')", []
    if isinstance(entity, ExecuteProcess):
        cmd = ', '.join(format_substitutions(word) for word in entity.cmd)
        cwd = None if entity.cwd is None else f"'{format_substitutions(entity.cwd)}'"
        env = None if entity.env is None else '{' + ', '.join(
            f'{format_substitutions(name)}: {format_substitutions(value)}'
            for name, value in entity.env) + '}'
        return f'ExecuteProcess(cmd=[{cmd}], cwd={cwd}, env={env}, shell={entity.shell})', []
    if isinstance(entity, RegisterEventHandler):
        text, entities = entity.event_handler.describe()
        return (f"RegisterEventHandler('{entity.event_handler}'):",
                [(text, [_describe(one) for one in entities])])
    kind = 'Action' if isinstance(entity, Action) else 'Unknown entity'
    return f"{kind}('{entity}')", []


def _draw(trees: Iterable[Tree], indentation: str) -> Iterable[str]:
    rest = list(trees)
    while rest:
        text, below = rest.pop(0)
        yield f"{indentation}{'├' if rest else '└'}── {text}"
        yield from _draw(below, indentation + ('│   ' if rest else '    '))


class LaunchIntrospector:

    def format_launch_description(self, launch_description: LaunchDescription) -> str:
        """Return the entities, not visited, as a tree in text."""
        trees = [_describe(entity) for entity in launch_description.entities]
        return '\n'.join([str(launch_description), *_draw(trees, '')])
