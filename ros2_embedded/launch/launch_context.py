# SPDX-License-Identifier: Apache-2.0
"""What one launch knows while it runs."""
from __future__ import annotations

import asyncio
import collections
import os
from typing import Any, Deque, Dict, Iterable, List, MutableMapping, Optional

import launch.logging

from ._base import BaseEventHandler, Event, Substitution


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
        self.__launch_configurations: Dict[str, Any] = {}
        self.__launch_configurations_stack: List[Dict[str, Any]] = []
        self.__environment_stack: List[Dict[str, str]] = []
        self.__environment_reset = dict(os.environ)
        self.__is_shutdown = False
        self.__asyncio_loop: Optional[asyncio.AbstractEventLoop] = None
        self.__logger = launch.logging.get_logger(__name__)

    @property
    def argv(self) -> Iterable[str]:
        return self.__argv

    @property
    def noninteractive(self) -> bool:
        return self.__noninteractive

    @property
    def is_shutdown(self) -> bool:
        return self.__is_shutdown

    def _set_is_shutdown(self, state: bool) -> None:
        self.__is_shutdown = state

    @property
    def asyncio_loop(self) -> Any:
        """The loop that the launch runs in; None while it doesn't."""
        return self.__asyncio_loop

    def _set_asyncio_loop(self, loop: Optional[asyncio.AbstractEventLoop]) -> None:
        self.__asyncio_loop = loop

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
        if self.__combined_locals is None:
            self.__combined_locals = {**self.__globals, **self.__locals}
        return self.__combined_locals

    @property
    def locals(self) -> Any:
        return _Locals(self.get_locals_as_dict())

    def _push_environment(self) -> None:
        self.__environment_stack.append(dict(os.environ))

    def _pop_environment(self) -> None:
        if not self.__environment_stack:
            raise RuntimeError('environment stack unexpectedly empty')
        self.__set_environment(self.__environment_stack.pop())

    def _reset_environment(self) -> None:
        self.__set_environment(self.__environment_reset)

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
        return self.__launch_configurations

    @property
    def environment(self) -> MutableMapping[str, str]:
        return os.environ

    def would_handle_event(self, event: Event) -> bool:
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
        self._event_handlers.remove(event_handler)

    def emit_event_sync(self, event: Event) -> None:
        self.__logger.debug(f"emitting event synchronously: '{event.name}'")
        self._event_queue.put_nowait(event)

    async def emit_event(self, event: Event) -> None:
        self.__logger.debug(f"emitting event: '{event.name}'")
        await self._event_queue.put(event)

    def perform_substitution(self, substitution: Substitution) -> str:
        return substitution.perform(self)
