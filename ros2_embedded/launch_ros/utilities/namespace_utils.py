# SPDX-License-Identifier: Apache-2.0
"""Namespaces, and whether names can be names of nodes."""
import re
from typing import Optional, TypeVar

OptionalText = TypeVar('OptionalText', str, None)

_NAME = '[A-Za-z_][A-Za-z0-9_]*'


def is_root_namespace(ns: str) -> bool:
    return ns == '/'


def is_namespace_absolute(ns: str) -> bool:
    return ns.startswith('/')


def prefix_namespace(base_ns: Optional[str], ns: Optional[str]) -> Optional[str]:
    """Return the namespace below the base, or as it is if absolute; None if both are."""
    if ns is None:
        combined = base_ns
    elif not base_ns or is_namespace_absolute(ns):
        combined = ns
    else:
        combined = f"{'' if is_root_namespace(base_ns) else base_ns}/{ns}"
    if combined is None or is_root_namespace(combined):
        return combined
    return combined.rstrip('/')


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
