# SPDX-License-Identifier: Apache-2.0
"""Signals as callbacks of an event loop."""
from __future__ import annotations

import asyncio
import os
import signal
import socket
from typing import Any, Callable


class AsyncSafeSignalManager:
    """
    While entered, calls handlers from the loop for signals that Python notices.

    It listens on :func:`signal.set_wakeup_fd` and leaves handlers of :func:`signal.signal`
    alone: a signal whose disposition is the operating system's default still has its default
    effect. Managers nest. ``signal.set_wakeup_fd``, also as asyncio calls it, is intercepted
    meanwhile, and the descriptor given there gets a copy of what arrives.

    :raises ValueError: on entering outside of the main thread.
    """

    __current: AsyncSafeSignalManager | None = None
    __real_set_wakeup_fd = staticmethod(signal.set_wakeup_fd)

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.__loop = loop
        self.__handlers: dict[int, Callable[[int], None]] = {}
        self.__next_fd = -1

    def __enter__(self) -> AsyncSafeSignalManager:
        self.__reader, self.__writer = socket.socketpair()
        self.__reader.setblocking(False)
        self.__writer.setblocking(False)
        try:
            self.__next_fd = self.__real_set_wakeup_fd(self.__writer.fileno())
        except ValueError:
            self.__reader.close()
            self.__writer.close()
            raise
        self.__loop.add_reader(self.__reader.fileno(), self.__on_readable)
        self.__before = AsyncSafeSignalManager.__current, signal.set_wakeup_fd
        AsyncSafeSignalManager.__current = self
        signal.set_wakeup_fd = self.__replace_next_fd
        return self

    def __exit__(self, *exc_info: Any) -> None:
        self.__loop.remove_reader(self.__reader.fileno())
        self.__real_set_wakeup_fd(self.__next_fd)
        AsyncSafeSignalManager.__current, signal.set_wakeup_fd = self.__before
        self.__reader.close()
        self.__writer.close()

    def __replace_next_fd(self, fd: int, *, warn_on_full_buffer: bool = True) -> int:
        previous, self.__next_fd = self.__next_fd, fd
        return previous

    def __on_readable(self) -> None:
        try:
            received = self.__reader.recv(4096)
        except (BlockingIOError, InterruptedError):
            return
        for number in received:
            handler = self.__handlers.get(number)
            if handler is not None:
                handler(number)
        if self.__next_fd != -1:
            os.write(self.__next_fd, received)

    def handle(
        self, signum: int, handler: Callable[[int], None] | None
    ) -> Callable[[int], None] | None:
        """Set what is called for a signal, None for nothing; return what it was."""
        previous = self.__handlers.pop(signum, None)
        if handler is not None:
            self.__handlers[signum] = handler
        return previous
