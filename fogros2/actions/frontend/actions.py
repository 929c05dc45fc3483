# SPDX-License-Identifier: Apache-2.0
"""Actions of XML and YAML for what Python has as objects: items of lists, a launch description."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast, Optional, TYPE_CHECKING, Union

from launch import Action, LaunchContext, LaunchDescriptionEntity

from fogros2.actions.launch_description import FogROSLaunchDescription
from fogros2.describe import features, values
from fogros2.errors import ConfigurationError
from fogros2.runtime.coordinator import Coordinator

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.model import RobotNodes


class Item(Action):
    """
    An item of a feature's list (:attr:`fogros2.feature.Feature.node_list`).

    Inside a node or a group the item is for that one only, which reads ``item``. Elsewhere it is
    for every machine of the launch.
    """

    def __init__(self, keyword: str, item: object, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.keyword = keyword
        self.item = item

    def execute(self, context: LaunchContext) -> None:
        """Execute the action: processes that execute later use the item."""
        Coordinator.of(context).parts.everywhere(
            {self.keyword: [self.item]}, context.launch_configurations.get('ros_namespace', '/'))


class FogROSLaunch(Action):
    """
    A FogROSLaunchDescription inside another description.

    :param actions: the content.
    :param robot_nodes: as for FogROSLaunchDescription, and ``dds`` too.
    """

    def __init__(
        self, actions: Iterable[Action], *,
        robot_nodes: SomeSubstitutionsType = 'after_cloud',
        dds: Optional[SomeSubstitutionsType] = None, **kwargs: Any,
    ) -> None:
        self._lists = features.take_lists(kwargs)
        super().__init__(**kwargs)
        self._actions = list(actions)
        self._robot_nodes: Union[SomeSubstitutionsType, RobotNodes] = robot_nodes
        self._dds = dds
        if isinstance(robot_nodes, str):
            self._description(robot_nodes, None)

    def get_sub_entities(self) -> list[LaunchDescriptionEntity]:
        """Return the content, because launch inspects sub-entities before execution."""
        return list(self._actions)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action: return the description."""
        return [self._description(values.resolve(context, self._robot_nodes),
                                  values.resolve(context, self._dds))]

    def _description(self, robot_nodes: str, dds: Optional[str]) -> FogROSLaunchDescription:
        return FogROSLaunchDescription(
            self._actions, robot_nodes=cast('RobotNodes', robot_nodes), dds=dds,
            **self._lists)


def separate(actions: Iterable[Action]) -> tuple[list[Action], dict[str, list[Any]]]:
    """
    Separate items of features' lists from other actions; return both, the items by keyword.

    :raises ConfigurationError: an item has a condition, which only one of the launch may.
    """
    others: list[Action] = []
    lists: dict[str, list[Any]] = {}
    for action in actions:
        if not isinstance(action, Item):
            others.append(action)
        elif action.condition is None:
            lists.setdefault(action.keyword, []).append(action.item)
        else:
            raise ConfigurationError(
                f'{action.item}: an element of {action.keyword} in a node or a group takes no '
                'condition', 'set the condition of the node or the group')
    return others, lists
