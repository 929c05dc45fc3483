# SPDX-License-Identifier: Apache-2.0
"""
Memory of pictures, kept from one to the next.

A picture of 1080p is 6 MB, in several buffers on its way. The C library gives such memory back to
the kernel each time it is freed, and the kernel hands it out again page by page, each zeroed: of
the 14 ms that a decoder took for such a picture, 7 went there.
"""

from __future__ import annotations

import ctypes

# malloc.h of the GNU C library; where another one is, nothing is changed
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
#: Bytes: the most that glibc takes for a buffer to come from its heap, and what it may keep free.
LARGEST, KEPT = 32 << 20, 256 << 20


def keep() -> bool:
    """
    Have this process reuse the memory of its pictures; call it before it starts threads.

    :return: whether the C library knows of it.
    """
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is None:
        return False
    # one heap, or what one thread frees couldn't be of use to another
    return all([mallopt(_ARENA_MAX, 1), mallopt(_MMAP_THRESHOLD, LARGEST),
                mallopt(_TRIM_THRESHOLD, KEPT)])
