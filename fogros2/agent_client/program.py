# SPDX-License-Identifier: Apache-2.0
"""The agent's program as it travels to machines: one file."""

from __future__ import annotations

import ast
import functools
from pathlib import Path

from fogros2 import agent

_HEADER = '#!/usr/bin/env python3\n# SPDX-License-Identifier: Apache-2.0\n'


@functools.lru_cache(maxsize=1)
def agent_program() -> str:
    """
    Return the modules of ``fogros2.agent`` as one program.

    Docstrings, comments and imports that only a type checker needs stay behind: launches send the
    program to machines.
    """
    imports, lines = set(), []
    for name in agent.MODULES:
        source = Path(agent.__file__).with_name(f'{name}.py').read_text(encoding='utf-8')
        module, kept = ast.parse(source), source.splitlines()
        for node in ast.walk(module):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                _replace(kept, node, f'{" " * node.col_offset}""')
        for statement in module.body:
            text = ast.unparse(statement)
            if isinstance(statement, (ast.Import, ast.ImportFrom)):
                imports.add(text)
            elif not text.startswith(('TYPE_CHECKING', 'if TYPE_CHECKING')):
                continue
            _replace(kept, statement, '')
        lines += [line.partition('  # ')[0] for line in kept if line and line.lstrip()[0] != '#']
    ours = f'from {agent.__name__}.'
    return _HEADER + '\n'.join([
        *sorted(line for line in imports if not line.startswith(ours)), *lines, ''])


def _replace(lines: list[str], node: ast.stmt, text: str) -> None:
    """Replace a statement in the lines of its module; the number of lines stays."""
    end = node.end_lineno or node.lineno
    lines[node.lineno - 1:end] = [text] + [''] * (end - node.lineno)
