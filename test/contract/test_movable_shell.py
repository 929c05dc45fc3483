# SPDX-License-Identifier: Apache-2.0
"""A shell that hands everything on keeps the contract of those it hands it to."""

from __future__ import annotations

from fogros2.model import Command
from fogros2.shell.movable import MovableShell
from fogros2.testing import FakeShell, ShellContract


class TestMovableShell(ShellContract):

    def make(self, folder):
        return MovableShell(FakeShell()), '/there'


def test_from_a_move_on_it_is_the_other_shell():
    before, after = FakeShell(), FakeShell()
    shell = MovableShell(before)
    shell.move(after)
    shell.run(Command(('true',)), timeout=1)
    assert (before.closed, before.commands, len(after.commands)) == (1, [], 1)
    shell.close()
    assert (before.closed, after.closed) == (1, 1)
