# SPDX-License-Identifier: Apache-2.0
"""ROS nodes that may run on a machine: launch_ros's actions with ``machine=``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, TYPE_CHECKING

from launch import LaunchContext, LaunchDescriptionEntity
import launch_ros.actions

from fogros2.describe import features, keywords, values
from fogros2.describe.machines import checked, CloudInstance
from fogros2.errors import ConfigurationError
from fogros2.runtime.coordinator import Coordinator
from fogros2.runtime.remote_process import RemoteProcess, send, send_components

if TYPE_CHECKING:
    from fogros2.describe.machines import SomeMachine


class Node(launch_ros.actions.Node):
    """
    A :class:`launch_ros.actions.Node` that runs on a machine if it has a ``machine``.

    It accepts all keywords of launch_ros's Node, and without a machine behaves like that Node.
    With a machine, conditions, ``respawn``, ``on_exit``, OnProcessStart, OnProcessExit and the
    like treat the machine's process as a local process, wherever the action is in the launch.

    :param machine: the machine, or the name of one that the launch mentions elsewhere; None for
        the robot, or for the machine of an enclosing CloudGroup.
    :param kwargs: also keywords and lists of features, see doc/developers/features.md.
    :raises ConfigurationError: ``machine`` is no machine, or another option needs one.
    """

    #: None without a machine of its own; that of an enclosing CloudGroup does not count.
    _remote: Optional[RemoteProcess] = None

    def __init__(
        self, *, machine: Optional[SomeMachine] = None, **kwargs: Any,
    ) -> None:
        self.lists = features.take_lists(kwargs)
        of_features = features.keywords('node_options')
        own = {name: kwargs.pop(name) for name in of_features if name in kwargs}
        with keywords.refused(type(self), of_features):
            super().__init__(**kwargs)
        if machine is None:
            for keyword, value in {**own, **self.lists}.items():
                if value is not None:
                    raise ConfigurationError(
                        f'{keyword}= of a node is for a machine, and this node has none',
                        f'add machine=, or leave {keyword}= out')
            return
        self._features = features.own(own, 'node_options')
        contained = any(own.get(keyword) is not None for keyword in features.containers())
        if contained and isinstance(machine, CloudInstance):
            machine.takes_containers()
        self._remote = send(self, checked(machine))
        self._remote.contained = contained

    def prepare(self, context: LaunchContext) -> None:
        """Resolve the action and its lists; relative topics are in the node's namespace."""
        remote = self._remote
        if remote is not None:
            remote.features = features.by_feature(
                values.resolve(context, self._features), 'node_options')
        super().prepare(context)
        if remote is not None:
            namespace = self.expanded_node_namespace
            if namespace == self.UNSPECIFIED_NODE_NAMESPACE:
                namespace = '/'
            remote.own = Coordinator.of(context).parts.resolve(self.lists, namespace)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action; components that it loads use the topic names of its machine."""
        entities: Optional[list[LaunchDescriptionEntity]] = super().execute(context)
        if self._remote is not None:
            for entity in entities or ():
                send_components(entity, self._remote.machine, self._remote.own, context)
        return entities


class LifecycleNode(Node, launch_ros.actions.LifecycleNode):
    """A :class:`launch_ros.actions.LifecycleNode` that takes ``machine`` as Node does."""


class ComposableNodeContainer(Node, launch_ros.actions.ComposableNodeContainer):
    """
    A :class:`launch_ros.actions.ComposableNodeContainer` that takes ``machine`` as Node does.

    The components in its ``composable_node_descriptions`` are loaded on the machine.
    """


class CloudNode(Node):
    """
    A Node that always has a machine.

    :param lists: features' lists, which launch files of FogROS2 give without a keyword.
    """

    def __init__(self, machine: SomeMachine, *lists: Sequence[Any], **kwargs: Any) -> None:
        names = [*features.node_lists()]
        if len(lists) > len(names):
            raise ConfigurationError('a CloudNode takes one machine, and the rest by keywords',
                                     'CloudNode(machine, package=..., executable=...)')
        super().__init__(machine=checked(machine), **dict(zip(names, lists)), **kwargs)
