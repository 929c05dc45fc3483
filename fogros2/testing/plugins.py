# SPDX-License-Identifier: Apache-2.0
"""A plugin that is there for the time of a test, for the launches that it starts too."""

from __future__ import annotations

import os
from pathlib import Path


def install(folder: Path, group: str, name: str, program: str, attribute: str) -> str:
    """
    Write a distribution with one entry point; return the PYTHONPATH by which it is found.

    :param folder: an empty folder.
    :param group: such as ``fogros2.provider``.
    :param name: of the plugin.
    :param program: its module's text.
    :param attribute: the class in it.
    """
    module = f'fogt_{name}'
    about = folder / f'{module}-0.dist-info'
    about.mkdir(parents=True)
    (about / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {module}\nVersion: 0\n')
    (about / 'entry_points.txt').write_text(f'[{group}]\n{name} = {module}:{attribute}\n')
    (folder / f'{module}.py').write_text(program)
    before = os.environ.get('PYTHONPATH')
    return f'{folder}{os.pathsep}{before}' if before else str(folder)
