# SPDX-License-Identifier: Apache-2.0
"""
Allow ``machine=`` on ``<node>`` and ``<node_container>``, only inside ``<fogros_launch>``.

launch has one table of elements for all launch files of a process, so these two elements must stay
launch_ros's own. A copy of the file's parser reads the content of a ``<fogros_launch>`` instead.
launch passes the parser on to every element with child actions, so the copy reads these too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import copy
import functools
from typing import TYPE_CHECKING

from launch import Action, LaunchDescription, LaunchDescriptionEntity
from launch.actions import IncludeLaunchDescription
from launch.frontend import Parser

from fogros2.actions import private
from fogros2.actions.nodes import ComposableNodeContainer, Node

if TYPE_CHECKING:
    from launch.frontend import Entity

_NODES = {'node': Node, 'node_container': ComposableNodeContainer}


def scoped(parser: Parser) -> Parser:
    """Return a parser that accepts ``machine`` on nodes, also in the files that it includes."""
    below = copy.copy(parser)
    vars(below)['parse_action'] = functools.partial(_parse_action, below)
    return below


def _parse_action(parser: Parser, entity: Entity) -> Action:
    if entity.type_name in _NODES and entity.get_attr(
            'machine', data_type=None, optional=True) is not None:
        from fogros2.actions.frontend import parsing
        cls, kwargs = parsing.node(entity, parser, _NODES[entity.type_name])
        node: Action = cls(**kwargs)
        return node
    action = type(parser).parse_action(parser, entity)
    if isinstance(action, IncludeLaunchDescription):
        _reach([action])
    return action


def _reach(entities: Iterable[LaunchDescriptionEntity]) -> None:
    """Make the includes among entities, at any depth, read their files with a scoped parser."""
    for entity in entities:
        if isinstance(entity, IncludeLaunchDescription):
            private.replace_reader(entity.launch_description_source, _read)
            continue
        below = [entity.describe_sub_entities(), *(
            some for _, some in entity.describe_conditional_sub_entities())]
        for some in below:
            _reach(some)


def _read(before: Callable[[str], LaunchDescription], path: str) -> LaunchDescription:
    if Parser.is_filename_valid(path):
        entity, parser = Parser.load(path)
        return scoped(parser).parse_description(entity)
    description = before(path)
    _reach(description.entities)
    return description
