# SPDX-License-Identifier: Apache-2.0
"""Describes launch descriptions for humans."""
from __future__ import annotations

from typing import Any, Iterable

from ._base import LaunchDescriptionEntity
from .actions import EmitEvent, ExecuteProcess, LogInfo, RegisterEventHandler
from .launch_description import LaunchDescription

Tree = tuple[str, list[Any]]


def _text(substitutions: Iterable[Any]) -> str:
    return ' + '.join(sub.describe() for sub in substitutions)


def _describe(entity: LaunchDescriptionEntity) -> Tree:
    if isinstance(entity, LogInfo):
        return f'LogInfo({_text(entity.msg)})', []
    if isinstance(entity, EmitEvent):
        return f"EmitEvent(event='{entity.event.name}')", []
    if isinstance(entity, ExecuteProcess):
        cmd = ', '.join(_text(word) for word in entity.cmd)
        cwd = entity.cwd and f"'{_text(entity.cwd)}'"
        env = entity.env and {_text(name): _text(value) for name, value in entity.env}
        return f'ExecuteProcess(cmd=[{cmd}], cwd={cwd}, env={env}, shell={entity.shell})', []
    if isinstance(entity, RegisterEventHandler):
        text, entities = entity.event_handler.describe()
        return (f"RegisterEventHandler('{entity.event_handler}'):",
                [(text, [_describe(one) for one in entities])])
    return f"Action('{entity}')", []


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
