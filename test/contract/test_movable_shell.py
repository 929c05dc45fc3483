# SPDX-License-Identifier: Apache-2.0
"""A shell that hands everything on to another one, which may be replaced."""

from __future__ import annotations

import threading

from fogros2.model import Command, Result
from fogros2.shell.movable import MovableShell
from fogros2.waiting import wait_until
from fogros2_testing import FakeShell


def test_from_a_move_on_it_is_the_other_shell():
    before, after = FakeShell(), FakeShell()
    shell = MovableShell(before)
    shell.move(after)
    shell.run(Command(('true',)), timeout=1)
    assert (before.closed, before.commands, len(after.commands)) == (1, [], 1)
    shell.close()
    assert (before.closed, after.closed) == (1, 1)


def test_what_runs_ends_on_the_shell_that_it_began_on():
    """Closed under it, that one would connect anew, where the port is shut by then."""
    begun, go_on, said = threading.Event(), threading.Event(), []

    def slow(command):
        begun.set()
        assert go_on.wait(60.0)
        said.append(before.closed)
        return Result(0, '', '')

    before, after = FakeShell(handlers={'slow': slow}), FakeShell()
    shell = MovableShell(before)
    running = threading.Thread(
        target=lambda: shell.run(Command(('slow',)), timeout=60.0))
    running.start()
    assert begun.wait(60.0)
    moving = threading.Thread(target=lambda: shell.move(after))
    moving.start()
    # a call of now takes the new way, and waits for nobody
    wait_until(lambda: shell.run(Command(('true',)), timeout=60.0) and len(after.commands) > 0,
               timeout=60.0, what='the new way')
    assert before.closed == 0
    go_on.set()
    for thread in (running, moving):
        thread.join(60.0)
    assert said == [0]
    assert before.closed == 1
