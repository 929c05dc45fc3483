# SPDX-License-Identifier: Apache-2.0
"""The agent's program as it travels to machines: one file."""

from __future__ import annotations

import functools
from pathlib import Path
import re

from fogros2 import agent

_HEADER = '#!/usr/bin/env python3\n# SPDX-License-Identifier: Apache-2.0\n'
#: What stays behind, but for the imports of other packages. Parsing takes a tenth of a launch.
_PARTS = re.compile(r'''
    ^[ ]*(?P<docstring>"""(?s:.*?)"""$)
    | ^(?:if[ ])?TYPE_CHECKING\b.*\n(?:\n*[ ]+.*\n)*
    | ^(?P<imported>(?:import|from)[ ][^(\n]*(?:\([^)]*\))?$)
    | ^[ ]*\#.*\n
    | [ ]{2}\#[ ].*
''', re.MULTILINE | re.VERBOSE)


@functools.lru_cache(maxsize=1)
def agent_program() -> str:
    """
    Return the modules of ``fogros2.agent`` as one program.

    Docstrings, comments and imports that only a type checker needs stay behind: launches send the
    program to machines.
    """
    imports = set()

    def replacement(part: re.Match[str]) -> str:
        if part['imported']:
            imports.add(' '.join(part['imported'].split()))
        return part[0].replace(part['docstring'], '""') if part['docstring'] else ''

    source = ''.join(Path(agent.__file__).with_name(f'{name}.py').read_text(encoding='utf-8')
                     for name in agent.MODULES)
    lines = [line for line in _PARTS.sub(replacement, source).splitlines() if line]
    ours = f'from {agent.__name__}.'
    return _HEADER + '\n'.join([
        *sorted(line for line in imports if not line.startswith(ours)), *lines, ''])
