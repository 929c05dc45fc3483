# SPDX-License-Identifier: Apache-2.0
"""Measure how much memory a piece of code takes, in a process of its own."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

#: Runs the code of a test and prints how many bytes more the process held, and what it printed.
_MEASURED = """\
import re, sys
from pathlib import Path
def peak():
    return 1024 * int(re.search(r'VmHWM:\\s*(\\d+)', Path('/proc/self/status').read_text())[1])
code = sys.stdin.read()
prepare, _, attack = code.partition('# attack\\n')
exec(prepare)
Path('/proc/self/clear_refs').write_text('5')
before = peak()
exec(attack)
print(peak() - before)
"""


def measure(code: str, folder: Path) -> tuple[int, list[str]]:
    """
    Run code; return its additional memory in bytes, and its lines.

    :param code: what comes before the line ``# attack`` is not measured.
    :param folder: the process's folder.
    """
    done = subprocess.run([sys.executable, '-c', _MEASURED], input=code, cwd=folder,
                          capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    *said, taken = [line for line in done.stdout.splitlines() if 'WARNING' not in line]
    print(f'{int(taken) / 1e6:.0f} MB, {said}')
    return int(taken), said
