# SPDX-License-Identifier: Apache-2.0
"""Read the element ``<replicated>``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from launch import Action

from fogros2.actions.frontend.actions import separate
from fogros2.actions.frontend.entity import complete, CONDITIONS, value
from fogros2.describe import features, kinds
from fogros2_features.replicas.action import Replicated

if TYPE_CHECKING:
    from launch.frontend import Entity, Parser

    from fogros2.actions.frontend.entity import Parsed


def replicated(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<replicated machines="a, b" services="/plan" topics="/in:/out">``."""
    _, kwargs = Action.parse(entity, parser)
    parameters: dict[str, kinds.Kind] = {
        'machines': 'list', 'services': 'list', 'topics': 'list', 'hedge_after': 'scalar',
        'deadline': 'scalar'}
    for name, kind in parameters.items():
        content = value(entity, parser, kinds.Keyword(name, kind))
        if content is not None:
            kwargs[name] = content
    kwargs.setdefault('machines', [])
    kwargs['actions'], lists = separate(map(parser.parse_action, entity.children))
    kwargs.update(lists)
    complete(entity, (*parameters, *features.node_lists().values(), *CONDITIONS))
    return Replicated, kwargs
