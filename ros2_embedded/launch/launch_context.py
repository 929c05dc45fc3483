# SPDX-License-Identifier: Apache-2.0
"""What one launch knows while it runs."""
from __future__ import annotations

import asyncio
import collections
import os
from typing import Any, Deque, Dict, Iterable, List, MutableMapping, Optional, TYPE_CHECKING

import launch.logging

from .event import Event
from .event_handler import BaseEventHandler

if TYPE_CHECKING:
    from .substitution import Substitution


class _Locals:
    """Read-only attributes of the context."""

    def __init__(self, values: Dict[str, Any]) -> None:
        self.__dict__['_values'] = values

    def __getattr__(self, name: str) -> Any:
        values = self.__dict__['_values']
        if name not in values:
            raise AttributeError(
                f"context.locals does not contain attribute '{name}', "
                f"it contains: [{', '.join(values)}]")
        return values[name]

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"can't set attribute '{name}', locals are read-only")


class LaunchContext:
    """
    Events, handlers, configurations, environment and local variables of a launch.

    :param argv: the launch's command line arguments.
    :param noninteractive: whether no terminal will send SIGINT to the processes.
    """

    def __init__(
        self, *, argv: Optional[Iterable[str]] = None, noninteractive: bool = False
    ) -> None:
        self.__argv = argv if argv is not None else []
        self.__noninteractive = noninteractive
        self._event_queue: asyncio.Queue[Event] = asyncio.Queue()
        self._event_handlers: Deque[BaseEventHandler] = collections.deque()
        self._completion_futures: List[asyncio.Future[Any]] = []
        self.__globals: Dict[str, Any] = {}
        self.__locals: Dict[str, Any] = {}
        self.__locals_stack: List[Dict[str, Any]] = []
        self.__combined_locals: Optional[Dict[str, Any]] = None
        self.__launch_configurations: Dict[str, str] = {}
        self.__launch_configurations_stack: List[Dict[str, str]] = []
        self.__environment_stack: List[Dict[str, str]] = []
        self.__environment_at_start = dict(os.environ)
        self.__is_shutdown = False
        self.__asyncio_loop: Optional[asyncio.AbstractEventLoop] = None
        self.__logger = launch.logging.get_logger(__name__)

    @property
    def argv(self) -> Iterable[str]:
        """The launch's command line arguments."""
        return self.__argv

    @property
    def noninteractive(self) -> bool:
        """Whether no terminal will send SIGINT to the processes."""
        return self.__noninteractive

    def _set_is_shutdown(self, state: bool) -> None:
        self.__is_shutdown = state

    @property
    def is_shutdown(self) -> bool:
        """Whether the launch is shutting down."""
        return self.__is_shutdown

    def _set_asyncio_loop(self, loop: Optional[asyncio.AbstractEventLoop]) -> None:
        self.__asyncio_loop = loop

    @property
    def asyncio_loop(self) -> Any:
        """The loop that the launch runs in, or None."""
        return self.__asyncio_loop

    def add_completion_future(self, completion_future: asyncio.Future[Any]) -> None:
        """Let the launch wait for this future before it is idle."""
        self._completion_futures.append(completion_future)

    def _push_locals(self) -> None:
        self.__locals_stack.append(dict(self.__locals))

    def _pop_locals(self) -> None:
        if not self.__locals_stack:
            raise RuntimeError('locals stack unexpectedly empty')
        self.__locals = self.__locals_stack.pop()
        self.__combined_locals = None

    def extend_globals(self, extensions: Dict[str, Any]) -> None:
        """Add local variables that outlive the handling of an event."""
        self.__globals.update(extensions)
        self.__combined_locals = None

    def extend_locals(self, extensions: Dict[str, Any]) -> None:
        """Add local variables that last until the event being handled is done with."""
        self.__locals.update(extensions)
        self.__combined_locals = None

    def get_locals_as_dict(self) -> Dict[str, Any]:
        """Return the local variables by name."""
        if self.__combined_locals is None:
            self.__combined_locals = {**self.__globals, **self.__locals}
        return self.__combined_locals

    @property
    def locals(self) -> Any:
        """The local variables as attributes."""
        return _Locals(self.get_locals_as_dict())

    def _push_environment(self) -> None:
        self.__environment_stack.append(dict(os.environ))

    def _pop_environment(self) -> None:
        if not self.__environment_stack:
            raise RuntimeError('environment stack unexpectedly empty')
        self.__set_environment(self.__environment_stack.pop())

    def _reset_environment(self) -> None:
        self.__set_environment(self.__environment_at_start)

    @staticmethod
    def __set_environment(environment: Dict[str, str]) -> None:
        os.environ.clear()
        os.environ.update(environment)

    def _push_launch_configurations(self) -> None:
        self.__launch_configurations_stack.append(dict(self.__launch_configurations))

    def _pop_launch_configurations(self) -> None:
        if not self.__launch_configurations_stack:
            raise RuntimeError('launch_configurations stack unexpectedly empty')
        self.__launch_configurations = self.__launch_configurations_stack.pop()

    @property
    def launch_configurations(self) -> Dict[str, Any]:
        """The launch configurations by name; texts, and launch_ros's lists beside them."""
        return self.__launch_configurations

    @property
    def environment(self) -> MutableMapping[str, str]:
        """The environment of this process and of those it will start."""
        return os.environ

    def would_handle_event(self, event: Event) -> bool:
        """Say whether any registered handler matches the event."""
        return any(handler.matches(event) for handler in self._event_handlers)

    def register_event_handler(
        self, event_handler: BaseEventHandler, append: bool = False
    ) -> None:
        """Add a handler, before all others or after them."""
        if append:
            self._event_handlers.append(event_handler)
        else:
            self._event_handlers.appendleft(event_handler)

    def unregister_event_handler(self, event_handler: BaseEventHandler) -> None:
        """
        Remove a handler.

        :raises ValueError: if it isn't registered.
        """
        self._event_handlers.remove(event_handler)

    def emit_event_sync(self, event: Event) -> None:
        """Queue an event, from within the loop's thread."""
        self.__logger.debug(f"emitting event synchronously: '{event.name}'")
        self._event_queue.put_nowait(event)

    async def emit_event(self, event: Event) -> None:
        """Queue an event."""
        self.__logger.debug(f"emitting event: '{event.name}'")
        await self._event_queue.put(event)

    def perform_substitution(self, substitution: Substitution) -> str:
        """Return the substitution's text in this context."""
        return substitution.perform(self)
