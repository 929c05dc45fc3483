# SPDX-License-Identifier: Apache-2.0
"""ROS domains that one test at a time has, whatever runs beside it on this computer."""

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
def taken() -> Iterator[str]:
    """Have a domain until the end of the context, or of this process."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        for number in itertools.islice(_next, HIGHEST):
            domain = str(1 + number % HIGHEST)
            with contextlib.suppress(OSError):
                lock.bind(f'\0fogros2-test-domain-{domain}')
                break
        else:
            raise RuntimeError('other tests have all ROS domains')
        yield domain
