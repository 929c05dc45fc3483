# SPDX-License-Identifier: Apache-2.0
"""Components that are loaded into a container on a machine, and what streamed topics are there."""

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

#: Where launch_ros keeps the remappings of SetRemap and of groups.
_REMAPS, _NAMESPACE = 'ros_remaps', 'ros_namespace'


def are_loaded_by(entity: LaunchDescriptionEntity) -> bool:
    """Return whether an entity loads components."""
    # by name: importing it takes longer than most launches have use for
    return any(cls.__name__ == 'LoadComposableNodes' for cls in type(entity).__mro__)


def send(
    entity: LaunchDescriptionEntity, machine: SomeMachine, streams: Sequence[Entry],
    context: LaunchContext,
) -> None:
    """
    Have components that an entity loads into a container on a machine use the streams there.

    :param entity: any other entity stays unchanged.
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
    Have an action that loads components tell them what topics are called on their machine.

    :param names: returns new names by the full old ones, when the action is executed.
    :param carriers: adds the components' streams, before that, and returns what carries them.
    """
    if 'execute' in vars(action):
        return  # another visit of it
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
    """Rewrite all remappings that the action is about to read, for the time of the block."""
    if not names:
        yield
        return
    from fogros2.image_transport.topics import absolute, rewrite
    configurations = context.launch_configurations
    group: Optional[list[tuple[str, str]]] = configurations.get(_REMAPS)
    components = [component for component in private.components(action)
                  if component.condition() is None or component.condition().evaluate(context)]
    # Jazzy's are a generator, which can be gone through once
    before = [None if component.remappings is None else list(component.remappings)
              for component in components]
    base = configurations.get(_NAMESPACE) or '/'
    try:
        for component, rules in zip(components, before):
            own = [(perform_substitutions(context, list(old)),
                    perform_substitutions(context, list(new))) for old, new in rules or ()]
            namespace = absolute(
                perform_substitutions(context, component.node_namespace or []) or base, base)
            # those of the group come first and count first, but they are one list for all
            # components: what they lead to is said once more here
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
