# SPDX-License-Identifier: Apache-2.0
"""Builds the documentation's site into ``.cache/docs``; any warning is an error."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
#: Help texts are as wide as the page.
COLUMNS = '88'
#: As ``ros2``: argparse begins a usage with the program's name.
_ROS2 = "import sys; sys.argv[0] = 'ros2'; from ros2cli.cli import main; sys.exit(main())"
_PAGE = """\
# Command line

The output of `ros2 fog -h` and of `-h` of each verb.
"""


def help_of(*words: str) -> str:
    """Return what a command says of itself."""
    return subprocess.run(
        [sys.executable, '-c', _ROS2, *words, '-h'], check=True, capture_output=True, text=True,
        env={**os.environ, 'COLUMNS': COLUMNS}).stdout.replace('\t', '    ')


def command_line(verbs: list[str]) -> str:
    """Return the page with the help of ``ros2 fog`` and all of its verbs."""
    parts = [_PAGE, f'```text\n{help_of("fog").strip()}\n```\n']
    for verb in verbs:
        parts.append(f'## `ros2 fog {verb}`\n\n```text\n{help_of("fog", verb).strip()}\n```\n')
    return '\n'.join(parts)


def verbs() -> list[str]:
    """Return the names of the verbs, sorted."""
    from fogros2 import plugin_system
    return plugin_system.names('fogros2.verb')


def main() -> int:
    """Write what is generated, and build."""
    (ROOT / 'doc/reference/command_line.md').write_text(command_line(verbs()))
    target = ROOT / '.cache/docs'
    status = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-q', '-W', '--keep-going', '-b', 'html', '-d',
         str(ROOT / '.cache/doctrees'), str(ROOT / 'doc'), str(target)]).returncode
    if status == 0:
        print(target / 'index.html')
    return status


if __name__ == '__main__':
    sys.exit(main())
