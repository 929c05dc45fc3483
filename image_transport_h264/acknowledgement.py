# SPDX-License-Identifier: Apache-2.0
"""Wait for the acknowledgements of a publisher's messages while other threads run."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

from rclpy.publisher import Publisher

#: Return codes of rcl (rcl/types.h): RCL_RET_OK, RCL_RET_TIMEOUT.
_OK, _TIMEOUT = 0, 2


def wait_for_all_acked(publisher: Publisher, seconds: float) -> bool:
    """
    Wait until reliable readers have all messages; return False after a time-out.

    rclpy's method of this name holds the interpreter's lock while it waits, so no other thread of
    the process could send an image or run a callback. This function calls rcl, without the lock.

    :param seconds: the time-out.
    :raises RuntimeError: the context is shut down, or the publisher is destroyed.
    """
    handle = publisher.handle
    with handle:  # another thread cannot destroy the publisher in this block
        result = _rcl_function()(handle.pointer, int(seconds * 1e9))
    if result not in (_OK, _TIMEOUT):
        raise RuntimeError(f'rcl_publisher_wait_for_all_acked returned {result}')
    return bool(result == _OK)


@functools.cache
def _rcl_function() -> Any:
    """Return ``rcl_publisher_wait_for_all_acked`` of the library that rclpy has loaded."""
    function = ctypes.CDLL('librcl.so').rcl_publisher_wait_for_all_acked
    function.argtypes = [ctypes.c_void_p, ctypes.c_int64]
    function.restype = ctypes.c_int
    return function
