# SPDX-License-Identifier: Apache-2.0
"""What one launch knows while it runs."""
from __future__ import annotations

import asyncio
import collections
import os
from typing import Any, Iterable, MutableMapping

import launch.logging


class _Locals:
    """Read-only attributes of the context."""

    def __init__(self, values: dict[str, Any]) -> None:
        vars(self).update(values)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"context.locals does not contain attribute '{name}', "
                             f"it contains: [{', '.join(vars(self))}]")

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"can't set attribute '{name}', locals are read-only")


class LaunchContext:
    """
    Events, handlers, configurations, environment and local variables of a launch.

    :param noninteractive: whether no terminal will send SIGINT to the processes.
    """

    def __init__(
        self, *, argv: Iterable[str] | None = None, noninteractive: bool = False
    ) -> None:
        self.argv: Iterable[str] = argv if argv is not None else []
        self.noninteractive = noninteractive
        self.is_shutdown = False
        #: The loop that the launch runs in; None while it doesn't.
        self.asyncio_loop: Any = None
        self.launch_configurations: dict[str, Any] = {}
        self._event_queue: asyncio.Queue[Any] = asyncio.Queue()
        self._event_handlers: collections.deque[Any] = collections.deque()
        self._completion_futures: list[asyncio.Future[Any]] = []
        self.__globals: dict[str, Any] = {}
        self.__locals: dict[str, Any] = {}
        self.__locals_stack: list[dict[str, Any]] = []
        self.__launch_configurations_stack: list[dict[str, Any]] = []
        self.__environment_stack: list[dict[str, str]] = []
        self.__environment_reset = dict(os.environ)
        self.__logger = launch.logging.get_logger(__name__)

    def _set_is_shutdown(self, state: bool) -> None:
        self.is_shutdown = state

    def _set_asyncio_loop(self, loop: asyncio.AbstractEventLoop | None) -> None:
        self.asyncio_loop = loop

    def add_completion_future(self, completion_future: asyncio.Future[Any]) -> None:
        """Let the launch wait for this future before it is idle."""
        self._completion_futures.append(completion_future)

    def _push_locals(self) -> None:
        self.__locals_stack.append(dict(self.__locals))

    def _pop_locals(self) -> None:
        self.__locals = self.__locals_stack.pop()

    def extend_globals(self, extensions: dict[str, Any]) -> None:
        """Add local variables that outlive the handling of an event."""
        self.__globals.update(extensions)

    def extend_locals(self, extensions: dict[str, Any]) -> None:
        """Add local variables that last until the event being handled is done with."""
        self.__locals.update(extensions)

    def get_locals_as_dict(self) -> dict[str, Any]:
        return {**self.__globals, **self.__locals}

    @property
    def locals(self) -> Any:
        return _Locals(self.get_locals_as_dict())

    def _push_environment(self) -> None:
        self.__environment_stack.append(dict(os.environ))

    def _pop_environment(self) -> None:
        self.__set_environment(self.__environment_stack.pop())

    def _reset_environment(self) -> None:
        self.__set_environment(self.__environment_reset)

    @staticmethod
    def __set_environment(environment: dict[str, str]) -> None:
        os.environ.clear()
        os.environ.update(environment)

    def _push_launch_configurations(self) -> None:
        self.__launch_configurations_stack.append(dict(self.launch_configurations))

    def _pop_launch_configurations(self) -> None:
        self.launch_configurations = self.__launch_configurations_stack.pop()

    @property
    def environment(self) -> MutableMapping[str, str]:
        return os.environ

    def register_event_handler(
        self, event_handler: Any, append: bool = False
    ) -> None:
        """Add a handler, before all others or after them."""
        add = self._event_handlers.append if append else self._event_handlers.appendleft
        add(event_handler)

    def unregister_event_handler(self, event_handler: Any) -> None:
        self._event_handlers.remove(event_handler)

    def emit_event_sync(self, event: Any) -> None:
        self.__logger.debug(f"emitting event synchronously: '{event.name}'")
        self._event_queue.put_nowait(event)

    async def emit_event(self, event: Any) -> None:
        self.__logger.debug(f"emitting event: '{event.name}'")
        await self._event_queue.put(event)

    def perform_substitution(self, substitution: Any) -> str:
        text: str = substitution.perform(self)
        return text
