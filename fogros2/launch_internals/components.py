# SPDX-License-Identifier: Apache-2.0
"""Rename topics for components that are loaded into a container on a machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from pathlib import Path
from typing import Any, Optional

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from fogros2.ros_names import absolute, rewrite

#: Launch configurations in which launch_ros keeps remappings (SetRemap) and the namespace.
_REMAPS, _NAMESPACE = 'ros_remaps', 'ros_namespace'


def of(action: Any) -> list[Any]:
    """Return the descriptions of the nodes that a LoadComposableNodes loads."""
    return list(vars(action).get('_LoadComposableNodes__composable_node_descriptions', ()))


def _loaded(action: Any, context: LaunchContext) -> list[Any]:
    return [component for component in of(action)
            if component.condition() is None or component.condition().evaluate(context)]


def parameters(action: Any, context: LaunchContext) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of each component that is loaded, and texts with its parameters."""
    from launch_ros.utilities import evaluate_parameters
    for component in _loaded(action, context):
        given = evaluate_parameters(context, component.parameters or ())
        yield perform_substitutions(context, component.node_name or component.node_plugin), [
            one.read_text(errors='replace') if isinstance(one, Path) and one.is_file()
            else str(one) for one in given]


def set_remappings(component: Any, rules: Any) -> None:
    """Set the remappings of a ComposableNode, in launch_ros's normal form."""
    names = [name for name in vars(component) if name.endswith('remappings')]
    vars(component)[names[0]] = rules


def are_loaded_by(entity: LaunchDescriptionEntity) -> bool:
    """Return whether an entity loads components."""
    # compare names: importing the class is slow, and most launches load no components
    return any(cls.__name__ == 'LoadComposableNodes' for cls in type(entity).__mro__)


def have_names(action: Action) -> bool:
    """Return whether :func:`rename_topics` has changed an action."""
    return 'execute' in vars(action)


def rename_topics(
    action: Action, names: Callable[[], Mapping[str, str]],
    beside: Callable[[], Sequence[LaunchDescriptionEntity]],
) -> None:
    """
    Make an action that loads components rename topics for them.

    :param names: returns new topic names by full old names, when the action is executed.
    :param beside: called before that; returns processes that run beside the components.
    """
    execute = action.execute

    def renaming(context: LaunchContext) -> list[LaunchDescriptionEntity]:
        added = beside()
        with _renamed(action, context, names()):
            entities = execute(context)
        return [*(entities or ()), *added]

    vars(action)['execute'] = renaming


@contextlib.contextmanager
def _renamed(
    action: Action, context: LaunchContext, names: Mapping[str, str],
) -> Iterator[None]:
    """Rewrite the remappings that the action is about to read, for the duration of the block."""
    if not names:
        yield
        return
    configurations = context.launch_configurations
    group: Optional[list[tuple[str, str]]] = configurations.get(_REMAPS)
    components = _loaded(action, context)
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
            set_remappings(component, [
                (normalize_to_list_of_substitutions(old), normalize_to_list_of_substitutions(new))
                for old, new in pairs])
        configurations[_REMAPS] = []
        yield
    finally:
        for component, rules in zip(components, before):
            set_remappings(component, rules)
        if group is None:
            configurations.pop(_REMAPS, None)
        else:
            configurations[_REMAPS] = group
