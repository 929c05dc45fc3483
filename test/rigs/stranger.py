# SPDX-License-Identifier: Apache-2.0
"""A process of another account of this computer."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import subprocess
import sys

from fogros2 import process
from fogros2.model import Command

#: The account that owns nothing.
NOBODY = 65534
_BECOME = f"""\
import os, sys
os.setgroups([])
os.setgid({NOBODY})
os.setuid({NOBODY})
"""


@contextlib.contextmanager
def stranger(code: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """
    Run Python code as another account while the body runs; needs root.

    The process starts as root, so that it finds Python in any folder.

    :param words: the arguments that the code finds in ``sys.argv[1:]``.
    """
    argv = process.argv(Command((sys.executable, '-I', '-S', '-c', _BECOME + code, *words),
                                sudo=True))
    child = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                             preexec_fn=os.setpgrp)
    try:
        yield child
    finally:
        process.end(child, sudo=argv[0] == 'sudo')
        child.communicate()
