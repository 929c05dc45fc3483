# SPDX-License-Identifier: Apache-2.0
"""Builds the documentation's site into ``.cache/docs``; any warning is an error."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path
import subprocess
import sys
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
#: Help texts are as wide as the page.
COLUMNS = '88'
_PAGE = """\
# Command line

The output of `ros2 fog -h` and of `-h` of each verb.
"""


def help_of(*words: str) -> str:
    """Return what a command says of itself."""
    from ros2cli.cli import main
    # argparse begins a usage with the program's name
    with mock.patch.dict(os.environ, COLUMNS=COLUMNS), mock.patch.object(sys, 'argv', ['ros2']), \
            contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        main(argv=[*words, '-h'])
    return said.getvalue().replace('\t', '    ')


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


def main(*options: str) -> int:
    """
    Write what is generated, and build.

    :param options: of sphinx-build.
    """
    (ROOT / 'doc/reference/command_line.md').write_text(command_line(verbs()))
    target = ROOT / '.cache/docs'
    status = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-q', '-W', '--keep-going', *options, '-b', 'html', '-d',
         str(ROOT / '.cache/doctrees'), str(ROOT / 'doc'), str(target)]).returncode
    if status == 0:
        print(target / 'index.html')
    return status


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
