# SPDX-License-Identifier: Apache-2.0
"""Rename streamed topics for components that are loaded into a container on a machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import functools
from typing import Optional, TYPE_CHECKING

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from fogros2.actions import private
from fogros2.actions.coordinator import Coordinator
from fogros2.actions.remote import carriers_here, carriers_of

if TYPE_CHECKING:
    from fogros2.actions.coordinator import SomeMachine
    from fogros2.image_transport.streams import Entry

#: Launch configurations in which launch_ros keeps remappings (SetRemap) and the namespace.
_REMAPS, _NAMESPACE = 'ros_remaps', 'ros_namespace'


def are_loaded_by(entity: LaunchDescriptionEntity) -> bool:
    """Return whether an entity loads components."""
    # compare names: importing the class is slow, and most launches load no components
    return any(cls.__name__ == 'LoadComposableNodes' for cls in type(entity).__mro__)


def send(
    entity: LaunchDescriptionEntity, machine: SomeMachine, streams: Sequence[Entry],
    context: LaunchContext,
) -> None:
    """
    Make the components that an entity loads on a machine use the machine's streams.

    :param entity: changed only if it loads components.
    """
    if not (isinstance(entity, Action) and are_loaded_by(entity)):
        return
    coordinator = Coordinator.of(context)
    if coordinator.on_robot(machine):
        tell(entity, dict, functools.partial(carriers_here, streams))
    else:
        session = coordinator.session(machine)
        tell(entity, session.told_to_components, functools.partial(
            carriers_of, streams, session=session))


def tell(
    action: Action, names: Callable[[], Mapping[str, str]],
    carriers: Callable[[LaunchContext], Sequence[LaunchDescriptionEntity]],
) -> None:
    """
    Make an action that loads components rename the streamed topics for them.

    :param names: returns new topic names by full old names, when the action is executed.
    :param carriers: called before that; adds the components' streams, returns republishers.
    """
    if 'execute' in vars(action):
        return  # an earlier visit has replaced it
    execute = action.execute

    def telling(context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        beside = carriers(context)
        with _renamed(action, context, names()):
            entities = execute(context)
        return [*(entities or ()), *beside]

    vars(action)['execute'] = telling


@contextlib.contextmanager
def _renamed(
    action: Action, context: LaunchContext, names: Mapping[str, str],
) -> Iterator[None]:
    """Rewrite the remappings that the action is about to read, for the duration of the block."""
    if not names:
        yield
        return
    from fogros2.image_transport.topics import absolute, rewrite
    configurations = context.launch_configurations
    group: Optional[list[tuple[str, str]]] = configurations.get(_REMAPS)
    components = [component for component in private.components(action)
                  if component.condition() is None or component.condition().evaluate(context)]
    # in Jazzy these are generators, which can be read only once
    before = [None if component.remappings is None else list(component.remappings)
              for component in components]
    base = configurations.get(_NAMESPACE) or '/'
    try:
        for component, rules in zip(components, before):
            own = [(perform_substitutions(context, list(old)),
                    perform_substitutions(context, list(new))) for old, new in rules or ()]
            namespace = absolute(
                perform_substitutions(context, component.node_namespace or []) or base, base)
            # the group's rules come first and win, but launch_ros applies one list to all
            # components: combine them with each component's own rules here
            pairs = rewrite([*(group or ()), *own], names, namespace)
            private.set_remappings(component, [
                (normalize_to_list_of_substitutions(old), normalize_to_list_of_substitutions(new))
                for old, new in pairs])
        configurations[_REMAPS] = []
        yield
    finally:
        for component, rules in zip(components, before):
            private.set_remappings(component, rules)
        if group is None:
            configurations.pop(_REMAPS, None)
        else:
            configurations[_REMAPS] = group
