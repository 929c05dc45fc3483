# SPDX-License-Identifier: Apache-2.0
"""CloudNode: a ROS node of the launch that runs on a machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, TYPE_CHECKING, Union

from launch import LaunchContext
from launch_ros.actions import Node

from fogros2 import containers
from fogros2.actions import streaming, words
from fogros2.actions.coordinator import Coordinator
from fogros2.actions.machines import CloudInstance
from fogros2.actions.remote import RemoteProcess
from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType, Substitution

    from fogros2.image_transport.streams import Entry


class CloudNode(Node, RemoteProcess):
    """
    A :class:`launch_ros.actions.Node` whose process is on a machine.

    It takes everything that Node takes; conditions, ``respawn``, ``on_exit``, OnProcessStart,
    OnProcessExit and the like work with it as with a Node, wherever in the launch it stands.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param stream_topics: image topics that cross the VPN encoded: ``(topic, transport)`` pairs for
        those that the robot publishes and the machine reads, or StreamTopic.
    :param image: container image that the node runs in on the machine, such as
        'ros:jazzy-perception', with the machine's network, DDS configuration and workspace.
    :param image_options: what ``docker run`` is told besides, such as ['--gpus=all']; of a
        substitution, the words that a comma parts.
    """

    def __init__(
        self, machine: Union[CloudInstance, SomeSubstitutionsType],
        stream_topics: Sequence[Entry] = (),
        image: Optional[SomeSubstitutionsType] = None,
        image_options: Union[Sequence[SomeSubstitutionsType], Substitution] = (), **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if not isinstance(machine, CloudInstance) and not words.is_text(machine):
            raise ConfigurationError(
                f'machine={machine!r} is no machine',
                'pass one such as ContainerInstance(), or the name of one')
        self._fogros2_machine = machine
        self.stream_topics = list(stream_topics)
        self._image = image
        self._image_options = words.items(image_options)
        if isinstance(image_options, str) or image_options and image is None:
            raise ConfigurationError(
                f'image_options={image_options!r} is no list of options for an image',
                "such as image='ros:jazzy-perception', image_options=['--gpus=all']")
        if image is not None and isinstance(machine, CloudInstance):
            machine.takes_containers()

    def prepare(self, context: LaunchContext) -> None:
        """Resolve the action, its streams too, whose relative names are in its namespace."""
        if self._image is not None:
            self._use_image(context)
        super().prepare(context)
        namespace = self.expanded_node_namespace
        if namespace == self.UNSPECIFIED_NODE_NAMESPACE:
            namespace = '/'
        self._fogros2_streams = streaming.resolve(context, self.stream_topics, namespace)
        streaming.check(self._fogros2_streams)

    def _use_image(self, context: LaunchContext) -> None:
        image = words.resolve(context, self._image)
        options = words.resolve(context, self._image_options)
        containers.node_container(image, options)
        if self.shell:
            raise ConfigurationError(
                f"a node in the image '{image}' can't run in a shell of the machine",
                'leave shell= out')
        if Coordinator.of(context).on_robot(self._fogros2_machine):
            raise ConfigurationError(
                f"the image '{image}' is for a machine, and the robot runs this node itself",
                'leave image= out for the robot, or choose another machine')
        self._fogros2_image, self._fogros2_image_options = image, options
