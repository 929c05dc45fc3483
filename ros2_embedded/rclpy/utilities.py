# SPDX-License-Identifier: Apache-2.0
"""The default context, and small helpers."""

from collections.abc import Sequence
import sys
import threading

from rclpy.context import Context

_default: Context | None = None
_lock = threading.Lock()


def get_default_context(*, shutting_down: bool = False) -> Context:
    """Give the context that is used where none is named; shutting down, forget it."""
    global _default
    with _lock:
        context = _default or Context()
        _default = None if shutting_down else context
        return context


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    """Give the arguments (``sys.argv``'s by default) that ROS doesn't use."""
    from rclpy._arguments import parse
    return parse(list(sys.argv if args is None else args)).others


def ok(*, context: Context | None = None) -> bool:
    """Say whether a context is initialized and not shut down."""
    return (context or get_default_context()).ok()


def shutdown(*, context: Context | None = None) -> None:
    """Shut a context down."""
    (context or get_default_context(shutting_down=True)).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Shut a context down unless it already is."""
    if context is None:
        context = get_default_context(shutting_down=True)
    context.try_shutdown()


def get_rmw_implementation_identifier() -> str:
    """Name the middleware."""
    return 'rmw_cyclonedds_cpp'
