# SPDX-License-Identifier: Apache-2.0
"""Let Ctrl-C reach several waiting threads, so that the program need not wait for them."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import signal
import threading
from types import FrameType
from typing import Optional


@contextlib.contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets in the block, just before it raises KeyboardInterrupt."""
    event = threading.Event()

    def interrupted(number: int, frame: Optional[FrameType]) -> None:
        event.set()
        signal.default_int_handler(number, frame)

    if threading.current_thread() is not threading.main_thread() \
            or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield event
        return
    signal.signal(signal.SIGINT, interrupted)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
