# SPDX-License-Identifier: Apache-2.0
"""Names and namespaces of nodes, and remappings."""
from __future__ import annotations

import re
from typing import Any, Iterable, Iterator, TypeVar

from launch.launch_context import LaunchContext
from launch.utilities import (
    ensure_argument_type,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)

__all__ = [
    'add_node_name', 'get_node_name_count', 'is_namespace_absolute', 'make_namespace_absolute',
    'normalize_remap_rule', 'normalize_remap_rules', 'prefix_namespace']

OptionalText = TypeVar('OptionalText', str, None)

_NAME = '[A-Za-z_][A-Za-z0-9_]*'
_COUNTS = 'unique_ros_node_names'


def prefix_namespace(base_ns: str | None, ns: str | None) -> str | None:
    """Return the namespace below the base, or as it is if absolute; None if both are."""
    if ns is None:
        combined = base_ns
    elif not base_ns or ns.startswith('/'):
        combined = ns
    else:
        combined = f"{'' if base_ns == '/' else base_ns}/{ns}"
    return combined if combined in (None, '/') else combined.rstrip('/')


def expand_namespace(context: LaunchContext, given: Any) -> str | None:
    """Return a node's absolute namespace below that of its group, None if neither has one."""
    namespace = None if given is None else perform_substitutions(
        context, normalize_to_list_of_substitutions(given))
    namespace = prefix_namespace(context.launch_configurations.get('ros_namespace'), namespace)
    return None if namespace is None else make_namespace_absolute(namespace)


def expand_remappings(context: LaunchContext, own: Iterable[Any]) -> list[tuple[str, str]]:
    """Return the remappings of a node's group, and then its own."""
    return [*context.launch_configurations.get('ros_remaps', ()), *(
        (perform_substitutions(context, source), perform_substitutions(context, target))
        for source, target in own)]


def is_namespace_absolute(ns: str) -> bool:
    return ns.startswith('/')


def make_namespace_absolute(ns: OptionalText) -> OptionalText:
    return ns if ns is None or is_namespace_absolute(ns) else '/' + ns


def check_node_name(name: str) -> None:
    """Raise rclpy's InvalidNodeNameException for what can't be a node's name."""
    if len(name) > 255 or not re.fullmatch(_NAME, name):
        # Only its error is needed: importing rclpy takes longer than all else here.
        from rclpy.validate_node_name import validate_node_name
        validate_node_name(name)


def check_namespace(namespace: str) -> None:
    """Raise rclpy's InvalidNamespaceException for what can't be an absolute namespace."""
    if len(namespace) > 245 or not re.fullmatch(f'/|(/{_NAME})+', namespace):
        from rclpy.validate_namespace import validate_namespace
        validate_namespace(namespace)


def get_node_name_count(context: LaunchContext, node_name: str) -> int:
    """Return how many nodes of that full name the launch has started."""
    counts: dict[str, int] = context.get_locals_as_dict().get(_COUNTS, {})
    return counts.get(node_name, 0)


def add_node_name(context: LaunchContext, node_name: str) -> str | None:
    """Count one more node of that full name; return a warning from the second on."""
    count = get_node_name_count(context, node_name) + 1
    counts = context.get_locals_as_dict().get(_COUNTS, {})
    context.extend_globals({_COUNTS: {**counts, node_name: count}})
    return None if count < 2 else (
        f'there are now at least {count} nodes with the name {node_name} '
        'created within this launch context')


def normalize_remap_rule(remap_rule: Any) -> tuple[Any, Any]:
    """Return a pair of names as substitutions."""
    ensure_argument_type(remap_rule, tuple, 'remap_rule')
    if len(remap_rule) != 2:
        raise TypeError(f'remap_rule must be a tuple of length 2, got length {len(remap_rule)}')
    source, target = remap_rule
    return (tuple(normalize_to_list_of_substitutions(source)),
            tuple(normalize_to_list_of_substitutions(target)))


def normalize_remap_rules(remap_rules: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
    yield from map(normalize_remap_rule, remap_rules)
