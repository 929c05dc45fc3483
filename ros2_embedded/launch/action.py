# SPDX-License-Identifier: Apache-2.0
"""Base of all actions."""
from __future__ import annotations

from typing import Any, Dict, Iterable, List, Optional, Tuple, Type, TYPE_CHECKING

from .condition import Condition
from .launch_context import LaunchContext
from .launch_description_entity import LaunchDescriptionEntity

if TYPE_CHECKING:
    from .frontend import Entity, Parser

ParsedAction = Tuple[Type['Action'], Dict[str, Any]]


class Action(LaunchDescriptionEntity):
    """
    An entity that does something, on condition.

    :param condition: evaluated when the action is visited; without one it always executes.
    """

    def __init__(self, *, condition: Optional[Condition] = None) -> None:
        self.__condition = condition

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        """
        Return this class and the keyword arguments that a frontend's entity gives.

        :raises RuntimeError: for both ``if`` and ``unless``.
        """
        from .conditions import IfCondition, UnlessCondition
        kwargs: Dict[str, Any] = {}
        for name, kind in (('if', IfCondition), ('unless', UnlessCondition)):
            expression = entity.get_attr(name, optional=True)
            if expression is None:
                continue
            if kwargs:
                raise RuntimeError("if and unless conditions can't be used simultaneously")
            kwargs['condition'] = kind(parser.parse_substitution(expression))
        return Action, kwargs

    @property
    def condition(self) -> Optional[Condition]:
        """The condition, if any."""
        return self.__condition

    def describe(self) -> str:
        return repr(self)

    def get_sub_entities(self) -> List[LaunchDescriptionEntity]:
        """Return what executing the action yields, as far as it is known before."""
        return []

    def describe_sub_entities(self) -> List[LaunchDescriptionEntity]:
        return self.get_sub_entities() if self.condition is None else []

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        if self.condition is None:
            return []
        return [(f'Conditionally included by {self.describe()}', self.get_sub_entities())]

    def visit(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        """Execute if the condition holds; ExecutionComplete follows, if anybody listens."""
        if self.__condition is not None and not self.__condition.evaluate(context):
            return None
        try:
            return self.execute(context)
        finally:
            from .events import ExecutionComplete
            event = ExecutionComplete(action=self)
            if context.would_handle_event(event):
                future = self.get_asyncio_future()
                if future is None:
                    context.emit_event_sync(event)
                else:
                    future.add_done_callback(lambda _: context.emit_event_sync(event))

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        """Do the action's work, without blocking; return what is to be visited next."""
        return None
