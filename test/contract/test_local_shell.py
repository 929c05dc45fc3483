# SPDX-License-Identifier: Apache-2.0
"""The shell of this computer keeps the contract."""

from __future__ import annotations

import os

from fogros2.model import Endpoint
from fogros2.shell.local import LocalShell
from fogros2_testing import ShellContract


class TestLocalShell(ShellContract):

    sudo = os.geteuid() == 0

    def make(self, folder):
        there = folder / 'there'
        there.mkdir()
        return LocalShell(Endpoint('local'), name='here'), str(there)
