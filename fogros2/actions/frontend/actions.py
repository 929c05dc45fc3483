# SPDX-License-Identifier: Apache-2.0
"""Actions of XML and YAML for what Python has as objects: a stream, a launch description."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast, Optional, TYPE_CHECKING, Union

from launch import Action, LaunchContext, LaunchDescriptionEntity

from fogros2.actions.launch_description import FogROSLaunchDescription
from fogros2.describe import values
from fogros2.errors import ConfigurationError
from fogros2.runtime.coordinator import Coordinator

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.image_transport.streams import StreamTopic
    from fogros2.model import RobotNodes


class StreamTopicEverywhere(Action):
    """
    Stream a topic between the robot and every machine of the launch.

    Inside a node or a CloudGroup the stream belongs to that one only, which reads ``entry``.
    """

    def __init__(self, entry: StreamTopic, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.entry = entry

    def execute(self, context: LaunchContext) -> None:
        """Execute the action: processes that execute later use the stream."""
        Coordinator.of(context).stream_everywhere(
            [self.entry], context.launch_configurations.get('ros_namespace', '/'))


class FogROSLaunch(Action):
    """
    A FogROSLaunchDescription inside another description.

    :param actions: the content.
    :param robot_nodes: as for FogROSLaunchDescription, and ``dds`` too.
    """

    def __init__(
        self, actions: Iterable[Action], *,
        robot_nodes: SomeSubstitutionsType = 'after_cloud',
        stream_topics: Sequence[StreamTopic] = (),
        dds: Optional[SomeSubstitutionsType] = None, **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self._actions = list(actions)
        self._robot_nodes: Union[SomeSubstitutionsType, RobotNodes] = robot_nodes
        self._stream_topics = list(stream_topics)
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
            self._actions, robot_nodes=cast('RobotNodes', robot_nodes),
            stream_topics=self._stream_topics, dds=dds)


def instead_of(actions: Iterable[Action]) -> tuple[list[Action], list[StreamTopic]]:
    """
    Separate streams from other actions; return both.

    :raises ConfigurationError: a stream has a condition, which only a stream of the launch may.
    """
    others: list[Action] = []
    entries: list[StreamTopic] = []
    for action in actions:
        if not isinstance(action, StreamTopicEverywhere):
            others.append(action)
        elif action.condition is None:
            entries.append(action.entry)
        else:
            raise ConfigurationError(
                f'{values.describe(action.entry.topic)}: a stream of a node or a group takes no '
                'condition', 'set the condition of the node or the group')
    return others, entries
