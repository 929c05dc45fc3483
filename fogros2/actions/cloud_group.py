# SPDX-License-Identifier: Apache-2.0
"""CloudGroup: run all processes of a part of the launch on a machine."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Optional, TYPE_CHECKING

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteLocal, GroupAction

from fogros2.describe import features, keywords
from fogros2.describe.machines import checked
from fogros2.launch_internals.wrapping import wrap
from fogros2.runtime.coordinator import Coordinator
from fogros2.runtime.remote_process import remote_of, send, send_components, stays

if TYPE_CHECKING:
    from fogros2.describe.machines import SomeMachine


class CloudGroup(GroupAction):
    """
    A :class:`launch.actions.GroupAction` whose processes run on a machine.

    Nodes, lifecycle nodes, component containers and ExecuteProcess actions of its content run
    there, at any depth and at any time: also from an included file, a timer, an OpaqueFunction or
    an event handler. All other actions execute on the robot, so configurations, namespaces,
    parameters and service calls work as in any group. A node with ``machine=``, or a nested
    CloudGroup, keeps its own machine.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param actions: the content.
    :param kwargs: also lists of features, as for Node.
    """

    def __init__(
        self, machine: SomeMachine, actions: Iterable[Action], **kwargs: Any,
    ) -> None:
        self.lists = features.take_lists(kwargs)
        with keywords.refused(type(self)):
            super().__init__(list(actions), **kwargs)
        self.machine = checked(machine)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the group: return its content, with remote processes in place of local ones."""
        if context.is_shutdown:
            return None
        coordinator = Coordinator.of(context)
        coordinator.know(self.machine)
        self._resolved = coordinator.resolve(self.machine)
        self._own = coordinator.parts.resolve(
            self.lists, context.launch_configurations.get('ros_namespace', '/'))
        return wrap(super().execute(context), self._send)

    def _send(self, entity: LaunchDescriptionEntity, context: LaunchContext) -> None:
        if isinstance(entity, Action) and entity.condition is not None and (
                not entity.condition.evaluate(context)):
            return  # launch skips it
        if isinstance(entity, ExecuteLocal) and remote_of(entity) is None and not stays(entity):
            send(entity, self._resolved, self._own)
        else:
            send_components(entity, self._resolved, self._own, context)
