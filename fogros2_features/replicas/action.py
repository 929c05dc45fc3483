# SPDX-License-Identifier: Apache-2.0
"""Replicated: run the same nodes on several machines, and use the first answer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import copy
from typing import Any, Optional, TYPE_CHECKING, Union

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteLocal, GroupAction

from fogros2.actions.cloud_group import CloudGroup
from fogros2.describe import features, values
from fogros2.describe.keywords import ROBOT
from fogros2.errors import ConfigurationError
from fogros2.launch_internals import components, private
from fogros2.launch_internals.wrapping import wrap
from fogros2.model import NodeSpec
from fogros2.ros_names import absolute, local_topic, remapped
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.coordinator import Coordinator
from fogros2.runtime.remote_process import keep, remote_of
from fogros2_features.replicas import starting

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import SomeMachine


class Replicated(Action):
    """
    Run the same nodes on several machines; the robot's nodes get the answer that comes first.

    The nodes have to be stateless: each request may reach several of them. See doc/replicas.md.

    :param machines: the machines, or their names; None, or the name 'robot', is the robot, whose
        own copy is asked last.
    :param actions: the content, of which each machine runs a copy.
    :param services: services of these nodes that the node ``first_answer`` serves on the robot.
    :param topics: pairs of an input of these nodes and the output that they make of it.
    :param hedge_after: milliseconds after which a request goes to the next machine, or 'p95', the
        learned 95th percentile; None: each request goes to all machines at once.
    :param deadline: seconds without an answer of a machine after which the robot's copy is asked.
    :param kwargs: also lists of features, as for Node.
    :raises ConfigurationError: too few machines, invalid or repeated names.
    """

    def __init__(
        self, machines: Union[Sequence[Optional[SomeMachine]], values.List],
        actions: Iterable[Action], *,
        services: Union[Sequence[SomeSubstitutionsType], values.List] = (),
        topics: Union[Sequence[tuple[SomeSubstitutionsType, SomeSubstitutionsType]],
                      values.List] = (),
        hedge_after: Union[float, SomeSubstitutionsType, None] = None,
        deadline: Union[float, SomeSubstitutionsType, None] = None,
        **kwargs: Any,
    ) -> None:
        self._lists = features.take_lists(kwargs)
        super().__init__(**kwargs)
        self._machines, self._actions = machines, list(actions)
        self._services, self._topics = services, topics
        self._hedge_after, self._deadline = hedge_after, deadline
        self._groups = [] if isinstance(machines, values.List) else [
            self._group(machine) for machine in machines]

    def get_sub_entities(self) -> list[LaunchDescriptionEntity]:
        """Return the group of each machine, because launch inspects sub-entities before."""
        return list(self._groups)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action: return the groups, and the node that serves the public names."""
        coordinator = Coordinator.of(context)
        namespace = context.launch_configurations.get('ros_namespace', '/')
        machines = values.resolve(context, self._machines) if isinstance(
            self._machines, values.List) else [*self._machines]
        services = [absolute(name, namespace) for name in values.resolve(
            context, values.items(self._services)) or ()]
        pairs = [_pair(pair, context, namespace) for pair in (
            values.resolve(context, self._topics) if isinstance(self._topics, values.List)
            else self._topics)]
        hedge_after = values.resolve(context, self._hedge_after)
        if isinstance(hedge_after, str) and hedge_after != 'p95':
            hedge_after = values.read_number(hedge_after) if hedge_after else None
        deadline = values.resolve(context, self._deadline)
        if isinstance(deadline, str):
            deadline = values.read_number(deadline) if deadline else None
        # checked before a machine is requested
        labels = [ROBOT if machine is None else coordinator.resolve(machine)
                  for machine in machines]
        starting.check([label if isinstance(label, str) else label.name for label in labels],
                       services, pairs, hedge_after, deadline)
        groups = [self._group(None) if label == ROBOT else group for label, group in zip(
            labels, self._groups or map(self._group, machines))]
        others = [label for label in labels if label != ROBOT]
        here = [coordinator.on_robot(machine) for machine in others]
        if all(here):
            return [GroupAction(copy.deepcopy(self._actions))]
        if any(here):
            raise ConfigurationError('replicas run partly on the robot, where their names are '
                                     'those of the first answer',
                                     'give all of them machines, or write None for the robot')
        sessions = {session.spec.name: session for session in map(coordinator.session, others)}
        forwarded = self._forwarded(coordinator, namespace, [output for _, output in pairs])
        public = [*services, *(name for pair in pairs for name in pair)]
        for name, session in sessions.items():
            for one in session.renamed.keys() & public:
                raise ConfigurationError(
                    f"two groups of replicas have '{one}' on the machine '{name}'",
                    'name it in one of them')
            session.rename({one: local_topic(one, name) for one in public},
                           others='the other replicas')
        first = starting.first_answer(
            coordinator.launch.store.launch_folder(coordinator.launch.id), sessions, services,
            [(*pair, pair[0] in forwarded) for pair in pairs], hedge_after, deadline, context)
        for group in groups:
            if isinstance(group, _Last):
                group.names = {one: local_topic(one, ROBOT) for one in public}
        return [*groups, first]

    def _group(self, machine: Optional[SomeMachine]) -> GroupAction:
        actions = copy.deepcopy(self._actions)
        if machine is None:
            return _Last(actions)
        return _Replica(machine, actions, **self._lists)

    def _forwarded(
        self, coordinator: Coordinator, namespace: str, outputs: Sequence[str],
    ) -> set[str]:
        """Return the topics that a feature brings from the robot to the machines."""
        topics = coordinator.parts.topics(coordinator.parts.resolve(self._lists, namespace))
        for topic, (keyword, _) in topics.items():
            if topic in outputs:
                raise ConfigurationError(
                    f'{topic} is an output of replicas and in {keyword}=',
                    f'leave it out of {keyword}: the first answer forwards it')
        return {topic for topic, (_, from_robot) in topics.items() if from_robot}


class _Replica(CloudGroup):
    """The content on one machine."""

    def _send(self, entity: LaunchDescriptionEntity, context: LaunchContext) -> None:
        _check(entity)
        super()._send(entity, context)
        if (remote := remote_of(entity)) is not None:
            remote.needed = False


class _Last(GroupAction):
    """
    The content on the robot.

    :ivar names: new names of topics and services by the public ones.
    """

    names: Mapping[str, str]

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        return wrap(super().execute(context), self._rename)

    def _rename(self, entity: LaunchDescriptionEntity, context: LaunchContext) -> None:
        _check(entity)
        if isinstance(entity, ExecuteLocal):
            private.change_command(entity, self._renamed)
            keep(entity)

    def _renamed(self, command: Sequence[str]) -> Sequence[str]:
        node = remapped(NodeSpec('', '', arguments=tuple(command)), self.names)
        return [str(word) for word in node.arguments]


def _check(entity: LaunchDescriptionEntity) -> None:
    lifecycle = any(cls.__name__ == 'LifecycleNode' for cls in type(entity).__mro__)
    if lifecycle or components.are_loaded_by(entity):
        raise ConfigurationError(
            f'{type(entity).__name__} cannot be replicated: the launch changes it by a '
            'service whose name all replicas have', 'run it on one machine')
    if isinstance(entity, CloudGroup) or (
            remote_of(entity) is not None and not isinstance(entity, AddedProcess)):
        raise ConfigurationError('a part of replicas has a machine of its own',
                                 'leave its machine= out, or move it out of Replicated')


def _pair(pair: Any, context: LaunchContext, namespace: str) -> tuple[str, str]:
    """Return the full names of an input and an output; XML and YAML write ``/in:/out``."""
    parts = values.resolve(context, pair).split(':') if values.is_text(pair) and not (
        isinstance(pair, tuple)) else [values.resolve(context, part) for part in pair]
    if len(parts) != 2 or not all(parts):
        raise ConfigurationError(
            f'{pair!r} is no pair of topics', "write ('/image', '/detections') in Python, "
            "'/image:/detections' in XML and YAML")
    return absolute(parts[0], namespace), absolute(parts[1], namespace)
