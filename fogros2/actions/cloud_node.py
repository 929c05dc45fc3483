# SPDX-License-Identifier: Apache-2.0
"""CloudNode: a ROS node of the launch that runs on a machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING, Union

from launch import LaunchContext
from launch_ros.actions import Node

from fogros2.actions import streaming, words
from fogros2.actions.machines import CloudInstance
from fogros2.actions.remote import RemoteProcess
from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.image_transport.streams import Entry


class CloudNode(Node, RemoteProcess):
    """
    A :class:`launch_ros.actions.Node` whose process is on a machine.

    It takes everything that Node takes; conditions, ``respawn``, ``on_exit``, OnProcessStart,
    OnProcessExit and the like work with it as with a Node, wherever in the launch it stands.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param stream_topics: image topics that cross the VPN encoded: ``(topic, transport)`` pairs for
        those that the robot publishes and the machine reads, or StreamTopic.
    """

    def __init__(
        self, machine: Union[CloudInstance, SomeSubstitutionsType],
        stream_topics: Sequence[Entry] = (), **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if not isinstance(machine, CloudInstance) and not words.is_text(machine):
            raise ConfigurationError(
                f'machine={machine!r} is no machine',
                'pass one such as ContainerInstance(), or the name of one')
        self._fogros2_machine = machine
        self.stream_topics = list(stream_topics)

    def prepare(self, context: LaunchContext) -> None:
        """Resolve the action, its streams too, whose relative names are in its namespace."""
        super().prepare(context)
        namespace = self.expanded_node_namespace
        if namespace == self.UNSPECIFIED_NODE_NAMESPACE:
            namespace = '/'
        self._fogros2_streams = streaming.resolve(context, self.stream_topics, namespace)
        streaming.check(self._fogros2_streams)
