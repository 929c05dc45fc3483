# SPDX-License-Identifier: Apache-2.0
"""The shell of this computer keeps the contract."""

from __future__ import annotations

import os

import pytest

from fogros2.model import Command, Endpoint
from fogros2.shell.local import LocalShell
from fogros2_testing import ShellContract


class TestLocalShell(ShellContract):

    sudo = os.geteuid() == 0

    def make(self, folder):
        there = folder / 'there'
        there.mkdir()
        return LocalShell(Endpoint('local'), name='here'), str(there)


def test_missing_program_is_named():
    shell = LocalShell(Endpoint('local'), name='here')
    with pytest.raises(RuntimeError, match='fogros2-nothing not found'):
        shell.open(Command(('fogros2-nothing',)))
