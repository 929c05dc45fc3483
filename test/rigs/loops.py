# SPDX-License-Identifier: Apache-2.0
"""Event loops for tests of coroutines."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar('T')


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    """
    Return the result of a coroutine.

    ``asyncio.run`` would leave this thread without an event loop, and ROS 2's launch, in a later
    test, expects the one that it has made.
    """
    loop = asyncio.new_event_loop()
    try:
        return loop.run_until_complete(coroutine)
    finally:
        loop.close()
