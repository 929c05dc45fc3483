# SPDX-License-Identifier: Apache-2.0
"""
Change elements of launch files for a part of a file only.

launch has one table of elements for all launch files of a process, so ``<node>`` must stay
launch_ros's own. A copy of the file's parser reads the content of a ``<fogros_launch>`` instead.
launch passes the parser on to every element with child actions, so the copy reads these too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import copy
import functools
from typing import Optional

from launch import Action, LaunchDescription, LaunchDescriptionEntity
from launch.actions import IncludeLaunchDescription
from launch.frontend import Entity, Parser

from fogros2.launch_internals import private
from fogros2.launch_internals.wrapping import everything

#: Creates the action of an element; None leaves the element to its usual parser.
Read = Callable[[Entity, Parser], Optional[Action]]


def scoped(parser: Parser, read: Read) -> Parser:
    """Return a parser that asks ``read`` first, also in the files that it includes."""
    inner = copy.copy(parser)

    def parse_action(entity: Entity) -> Action:
        try:
            action = read(entity, inner)
        except Exception as error:
            vars(error).setdefault('line', getattr(entity, 'line', None))
            raise
        if action is None:
            action = type(inner).parse_action(inner, entity)
            if isinstance(action, IncludeLaunchDescription):
                _reach([action], read)
        return action

    vars(inner)['parse_action'] = parse_action
    return inner


def _reach(entities: Iterable[LaunchDescriptionEntity], read: Read) -> None:
    """Make the includes among entities, at any depth, read their files with a scoped parser."""
    for entity in everything(entities):
        if isinstance(entity, IncludeLaunchDescription):
            private.replace_reader(
                entity.launch_description_source, functools.partial(_read_file, read))


def _read_file(
    read: Read, before: Callable[[str], LaunchDescription], path: str,
) -> LaunchDescription:
    if Parser.is_filename_valid(path):
        entity, parser = Parser.load(path)
        return scoped(parser, read).parse_description(entity)
    description = before(path)
    _reach(description.entities, read)
    return description
