# SPDX-License-Identifier: Apache-2.0
"""The memory of pictures is reused: the kernel is asked for it once, and not for each of them."""

from __future__ import annotations

import ctypes
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]

#: Makes and drops pictures in a thread, as a node's worker does; prints the pages it was given.
PROGRAM = """
import resource
import sys
import threading

from image_transport_h264 import memory

if sys.argv[1] == 'keep':
    memory.keep()


def work():
    for _ in range(number):
        pictures = [bytearray(6_000_000) for _ in range(3)]
        for picture in pictures:
            picture[::4096] = bytes(len(range(0, 6_000_000, 4096)))


for number in (3, 20):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), 'mallopt'), reason='another C library than GNU')
def test_pages_are_reused() -> None:
    pages = {what: int(subprocess.run(
        [sys.executable, '-c', PROGRAM, what], cwd=ROOT, check=True, capture_output=True,
        timeout=30).stdout) for what in ('keep', 'let go')}
    one = 6_000_000 // 4096
    assert pages['keep'] < 2 * one < pages['let go'], pages
