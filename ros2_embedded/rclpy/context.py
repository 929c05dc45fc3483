# SPDX-License-Identifier: Apache-2.0
"""A context: one participant in the domain, from ``init`` to ``shutdown``."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from inspect import ismethod
import sys
import threading
from types import TracebackType
from typing import Any, TYPE_CHECKING
from weakref import WeakMethod

from rclpy.exceptions import RCLError

if TYPE_CHECKING:
    from rclpy._arguments import Arguments
    from rclpy._graph import Graph


class Context(AbstractContextManager['Context']):
    """Holds what nodes share; may be initialized once."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._callbacks: list[Any] = []
        self._wakers: set[Callable[[], None]] = set()  # called from any thread, must not block
        self._valid = False
        self._graph: Graph | None = None
        self._arguments: Arguments | None = None
        self._domain_id = 0

    def init(self, args: list[str] | None = None, *, initialize_logging: bool = True,
             domain_id: int | None = None) -> None:
        """
        Join the domain.

        :param args: the command line, ``sys.argv`` by default.
        :param domain_id: the domain, by default that of ROS_DOMAIN_ID, or 0.
        :raises RuntimeError: if it was called before, or the domain can't be joined.
        """
        # what follows takes a while to import and is needed only here
        from rclpy import _arguments, _graph, _rmw, logging
        with self._lock:
            if domain_id is not None and domain_id < 0:
                raise RuntimeError(f'Domain id ({domain_id}) should not be lower than zero.')
            if self._graph is not None:
                raise RuntimeError('Context.init() must only be called once')
            arguments = _arguments.parse(
                list(sys.argv if args is None else args), 'failed to initialize rcl')
            _arguments.check_known(arguments)
            self._domain_id = _rmw.domain_id(domain_id)
            if initialize_logging:
                logging._configure(arguments)
            self._graph = _graph.Graph(self._domain_id, arguments.enclave)
            self._arguments = arguments
            self._valid = True
        from rclpy import signals
        signals.watch(self)

    def ok(self) -> bool:
        """Say whether it is initialized and not shut down."""
        return self._valid

    def _interrupt(self) -> None:
        """Become invalid because of a signal, and wake everybody."""
        self._valid = False
        for wake in list(self._wakers):
            wake()

    def _shut_down(self) -> None:
        self._interrupt()
        callbacks, self._callbacks = self._callbacks, []
        for reference in callbacks:
            callback = reference() if isinstance(reference, WeakMethod) else reference
            if callback is not None:
                callback()
        assert self._graph is not None
        self._graph.close()

    def shutdown(self) -> None:
        """
        Leave the domain.

        :raises RuntimeError: if it isn't initialized, or was shut down before.
        """
        if self._graph is None:
            raise RuntimeError('Context must be initialized before it can be shutdown')
        with self._lock:
            if not self._valid:
                raise RCLError(
                    'failed to shutdown: rcl_shutdown already called on the given context')
            self._shut_down()

    def try_shutdown(self) -> None:
        """Leave the domain unless that happened before."""
        with self._lock:
            if self._valid:
                self._shut_down()
            elif self._graph is not None:
                self._graph.close()  # a signal made it invalid, its entities are still there

    def on_shutdown(self, callback: Callable[[], None]) -> None:
        """Call this on shutdown, or now if that is over."""
        if not callable(callback):
            raise TypeError(f'callback should be a callable, got {type(callback)}')
        with self._lock:
            if self._graph is not None and not self._valid:
                callback()
            elif ismethod(callback):
                self._callbacks.append(WeakMethod(callback, self._forget))
            else:
                self._callbacks.append(callback)

    def _forget(self, reference: Any) -> None:
        if reference in self._callbacks:
            self._callbacks.remove(reference)

    def get_domain_id(self) -> int:
        """Give the domain's id."""
        if self._graph is None:
            raise RuntimeError('Context must be initialized before it can have a domain id')
        return self._domain_id

    def __enter__(self) -> 'Context':
        self.init()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.try_shutdown()
