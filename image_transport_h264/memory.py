# SPDX-License-Identifier: Apache-2.0
"""
Keep freed memory of pictures and serialized messages in the process.

A 1080p picture has 6 MB, and passes through several buffers. The C library returns such memory to
the kernel at each free. The kernel then hands it out page by page and zeroes each page. This took
7 of the 14 ms for which a decoder worked on such a picture, and a third of the time for which a
relay worked on a VGA image.
"""

from __future__ import annotations

import ctypes

# Constants of malloc.h of the GNU C library; with another C library, keep() does nothing.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
#: Largest buffer that glibc takes from its heap, and maximum free memory that it keeps, in bytes.
LARGEST, KEPT = 32 << 20, 256 << 20


def keep() -> bool:
    """
    Let this process reuse the memory of its messages; call this before the first thread starts.

    :return: whether the C library supports it.
    """
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is None:
        return False
    # A single heap, so that one thread can reuse memory that another one freed.
    return all([mallopt(_ARENA_MAX, 1), mallopt(_MMAP_THRESHOLD, LARGEST),
                mallopt(_TRIM_THRESHOLD, KEPT)])
