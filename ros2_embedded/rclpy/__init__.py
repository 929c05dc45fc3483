# SPDX-License-Identifier: Apache-2.0
"""
ROS 2's client library for Python, as far as the embedded default has it.

The names, signatures and behaviour are those of ROS 2 Jazzy's ``rclpy``.
"""

from typing import Any, TYPE_CHECKING

from rclpy.context import Context
from rclpy.signals import install_signal_handlers, SignalHandlerOptions, uninstall_signal_handlers
from rclpy.task import Future
from rclpy.utilities import (
    get_default_context,
    get_rmw_implementation_identifier,
    ok,
    try_shutdown,
)
from rclpy.utilities import shutdown as _shutdown
import rosidl_embedded.lacking  # noqa: F401 - names the modules that aren't here

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node

__all__ = ['create_node', 'get_default_context', 'get_global_executor',
           'get_rmw_implementation_identifier', 'init', 'ok', 'shutdown', 'spin', 'spin_once',
           'spin_until_future_complete', 'try_shutdown']


def init(*, args: list[str] | None = None, context: Context | None = None,
         domain_id: int | None = None,
         signal_handler_options: SignalHandlerOptions | None = None) -> None:
    """
    Initialize a context, by default the default one.

    :param args: the command line, ``sys.argv`` by default.
    :param domain_id: by default ROS_DOMAIN_ID's.
    :param signal_handler_options: by default SIGINT and SIGTERM shut the default context down.
    """
    default = get_default_context()
    context = default if context is None else context
    if signal_handler_options is None:
        signal_handler_options = SignalHandlerOptions.ALL if context is default \
            else SignalHandlerOptions.NO
    context.init(args, domain_id=domain_id)
    install_signal_handlers(signal_handler_options)


_executor: 'Executor | None' = None


def get_global_executor() -> 'Executor':
    """Give the executor that is used where none is named."""
    global _executor
    if _executor is None:
        from rclpy.executors import SingleThreadedExecutor
        _executor = SingleThreadedExecutor()

        def reset() -> None:
            global _executor
            if _executor is not None:
                _executor.shutdown()
                _executor = None
        get_default_context().on_shutdown(reset)
    return _executor


def shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:
    """
    Shut a context down, by default the default one.

    :param uninstall_handlers: of signals; by default with the default context.
    """
    default = context is None or context is get_default_context()
    _shutdown(context=context)
    if uninstall_handlers or uninstall_handlers is None and default:
        uninstall_signal_handlers()


def create_node(node_name: str, **options: Any) -> 'Node':
    """Create a node; see :class:`rclpy.node.Node` for the options."""
    from rclpy.node import Node
    return Node(node_name, **options)


def spin_once(node: 'Node', *, executor: 'Executor | None' = None,
              timeout_sec: float | None = None) -> None:
    """Wait for one callback of a node and execute it; None or negative: without limit."""
    executor = get_global_executor() if executor is None else executor
    try:
        executor.add_node(node)
        executor.spin_once(timeout_sec=timeout_sec)
    finally:
        executor.remove_node(node)


def spin(node: 'Node', executor: 'Executor | None' = None) -> None:
    """Execute the callbacks of a node until the context is shut down."""
    executor = get_global_executor() if executor is None else executor
    try:
        executor.add_node(node)
        while executor.context.ok():
            executor.spin_once()
    finally:
        executor.remove_node(node)


def spin_until_future_complete(node: 'Node', future: Future,
                               executor: 'Executor | None' = None,
                               timeout_sec: float | None = None) -> None:
    """Execute the callbacks of a node until a future is done, or the time is over."""
    executor = get_global_executor() if executor is None else executor
    added = False
    try:
        added = executor.add_node(node)
        executor.spin_until_future_complete(future, timeout_sec)
    finally:
        if added:
            executor.remove_node(node)
