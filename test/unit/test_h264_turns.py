# SPDX-License-Identifier: Apache-2.0
"""Large messages of several nodes, one at a time: real processes and the kernel's locks."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import os
from pathlib import Path
import subprocess
import sys
import threading

import pytest

from fogros2.waiting import wait_until
from image_transport_h264.turns import Turns

HOLDER = """
from pathlib import Path
import sys
from image_transport_h264.turns import Turns
with Turns(Path(sys.argv[1])).taken(5) as ours:
    print(ours, flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holder(path: Path) -> Iterator[subprocess.Popen[str]]:
    """Run another process that has the turn until its input ends."""
    with subprocess.Popen([sys.executable, '-c', HOLDER, str(path)], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == 'True\n'
        yield process


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a file that no node outside of this test goes by."""
    path = tmp_path / 'turns'
    path.touch()
    return path


@pytest.fixture
def turns(path: Path) -> Iterator[Turns]:
    """Return what one node has."""
    one = Turns(path)
    yield one
    one.close()


def test_who_has_no_turn_waits_for_the_other_process(turns: Turns, path: Path) -> None:
    with holder(path) as process:
        with turns.taken(0.05) as ours:
            # and goes on without: one who hangs holds nobody up for ever
            assert not ours
        assert process.stdin is not None
        process.stdin.close()
        with turns.taken(10) as ours:
            assert ours


def test_the_turn_of_one_who_was_killed_is_free(turns: Turns, path: Path) -> None:
    with holder(path) as process:
        process.kill()
        with turns.taken(10) as ours:
            assert ours


def test_who_waits_comes_before_who_just_had_it(turns: Turns, path: Path) -> None:
    order: list[str] = []

    def send() -> None:
        other = Turns(path)
        with other.taken(30):
            order.append('other')
        other.close()

    thread = threading.Thread(target=send)
    with turns.taken(10):
        thread.start()
        wait_until(lambda: in_line(path.parent), timeout=60,
                   what='the other one to get in line', longest=0.02)
        order.append('first')
    with turns.taken(10):
        order.append('again')
    thread.join(60)
    assert order == ['first', 'other', 'again']


def in_line(folder: Path) -> bool:
    """Return whether somebody waits for the turn: he has the lock on the folder."""
    file = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False


def test_without_files_to_lock_nobody_waits(turns: Turns) -> None:
    turns.close()
    with turns.taken(5) as ours:
        assert not ours
