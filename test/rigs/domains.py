# SPDX-License-Identifier: Apache-2.0
"""Numbers that one test at a time has, whatever runs beside it on this computer."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import itertools
import os
import socket

#: Above it, ports of DDS would be among those that the kernel gives to clients.
HIGHEST = 100
#: A domain is taken again as late as possible: someone may still leave it.
_next = itertools.count(os.getpid())


@contextlib.contextmanager
def number(what: str, count: int) -> Iterator[int]:
    """Have one of ``count`` numbers until the end of the context, or of this process."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        for each in itertools.islice(_next, count):
            with contextlib.suppress(OSError):
                lock.bind(f'\0fogros2-test-{what}-{each % count}')
                break
        else:
            raise RuntimeError(f'other tests have all numbers of a {what}')
        yield each % count


@contextlib.contextmanager
def taken() -> Iterator[str]:
    """Have a ROS domain until the end of the context, or of this process."""
    with number('domain', HIGHEST) as domain:
        yield str(1 + domain)
