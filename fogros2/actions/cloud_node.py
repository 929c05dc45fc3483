# SPDX-License-Identifier: Apache-2.0
"""CloudNode: a ROS node of the launch that runs on a machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, Union

from launch import LaunchContext, LaunchDescriptionEntity
from launch_ros.actions import Node

from fogros2.actions.coordinator import Coordinator
from fogros2.actions.machines import CloudInstance
from fogros2.actions.remote import RemoteProcess
from fogros2.errors import ConfigurationError
from fogros2.model import Stream


class CloudNode(Node, RemoteProcess):
    """
    A :class:`launch_ros.actions.Node` whose process is on a machine.

    It takes everything that Node takes; conditions, ``respawn``, ``on_exit``, OnProcessStart,
    OnProcessExit and the like work with it as with a Node, wherever in the launch it stands.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param stream_topics: ``(topic, transport)`` pairs: topics that the robot publishes and the
        node reads, encoded on their way.
    """

    def __init__(
        self, machine: Union[CloudInstance, str],
        stream_topics: Sequence[tuple[str, str]] = (), **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if not isinstance(machine, (CloudInstance, str)):
            raise ConfigurationError(
                f'machine={machine!r} is no machine',
                'pass one such as ContainerInstance(), or the name of one')
        self._fogros2_machine = machine
        self.stream_topics = list(stream_topics)

    def streams(self, machine: str) -> list[Stream]:
        """
        Return the streams asked for, from the robot to ``machine``.

        :raises ConfigurationError: no image transport is called so.
        """
        if not self.stream_topics:
            return []
        # the reader of entry points is slow to import, and needed for this alone
        from fogros2 import plugin_system
        streams = []
        for topic, transport in self.stream_topics:
            plugin_system.load('fogros2.image_transport', transport)
            streams.append(Stream(topic, transport, target=machine))
        return streams

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action: the process starts as soon as the machine is up."""
        if context.is_shutdown:
            return None
        coordinator = Coordinator.of(context)
        self.streams(coordinator.session(self._fogros2_machine).spec.name)
        return super().execute(context)
