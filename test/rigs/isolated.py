# SPDX-License-Identifier: Apache-2.0
"""A server in a network namespace of its own, for programs that must not get out."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import shutil
import subprocess
from typing import Any

import pytest

from rigs import serving
from rigs.computers import netns


@contextlib.contextmanager
def serve(
    app: Any, program: str, port: int,
) -> Iterator[list[str]]:
    """
    Serve a WSGI application in a new namespace with nothing but a loopback, until the test ends.

    It skips the test where ``program`` is missing or where the namespace takes more rights.

    :param program: runs there.
    :yields: the words before a command that runs there.
    """
    for needed in (program, 'ip', 'unshare', 'nsenter'):
        if shutil.which(needed) is None:
            pytest.skip(f'needs {needed} on PATH')
    if os.geteuid() != 0:
        pytest.skip(f'needs root: {program} gets a network namespace')
    # the namespace is there as long as this process, which ends with its input
    with subprocess.Popen(['unshare', '--net', 'sh', '-c', 'ip link set lo up && echo up && cat'],
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdin is not None and holder.stdout is not None
        assert holder.stdout.readline() == b'up\n'
        space = f'/proc/{holder.pid}/ns/net'
        with netns.listener(space, '127.0.0.1', port) as listener, \
                serving.serve(app, port, fd=os.dup(listener.fileno())):
            yield ['nsenter', f'--net={space}']
