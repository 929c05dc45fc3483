# SPDX-License-Identifier: Apache-2.0
"""The agent's program as it travels: its modules in one file."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path
import subprocess
import sys

from fogros2 import agent
from fogros2.agent_client import agent_program


def names(statements: list[ast.stmt]) -> list[str]:
    """Return the names that statements define at their level."""
    found = []
    for statement in statements:
        if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
            found.append(statement.name)
        for node in ast.walk(statement) if isinstance(
                statement, (ast.Assign, ast.AnnAssign)) else ():
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.append(node.id)
    return found


def test_joined_modules_share_no_name():
    counts = Counter(names(ast.parse(agent_program(), feature_version=(3, 10)).body))
    assert counts and max(counts.values()) == 1, counts.most_common(3)


def test_joined_program_imports_the_standard_library_only():
    for node in ast.walk(ast.parse(agent_program())):
        if isinstance(node, ast.Import):
            assert {name.name for name in node.names} <= sys.stdlib_module_names
        elif isinstance(node, ast.ImportFrom):
            assert str(node.module).split('.')[0] in sys.stdlib_module_names


def test_joined_program_has_every_module():
    files = {path.stem for path in Path(agent.__file__).parent.glob('*.py')}
    assert files == {'__init__', *agent.MODULES}


def test_joined_program_does_what_its_modules_do():
    """Without docstrings, imports and types, both have the same syntax tree."""
    def tree(source: str) -> list[str]:
        module = ast.parse(source)
        for node in ast.walk(module):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                node.value.value = ''
        return [ast.dump(statement) for statement in module.body
                if not isinstance(statement, (ast.Import, ast.ImportFrom, ast.Expr))
                and not ast.unparse(statement).startswith(('TYPE_CHECKING', 'if TYPE_CHECKING'))]

    folder = Path(agent.__file__).parent
    parts = [tree((folder / f'{name}.py').read_text()) for name in agent.MODULES]
    assert tree(agent_program()) == sum(parts, [])


def test_joined_program_runs_alone(tmp_path):
    path = tmp_path / 'agent.py'
    path.write_text(agent_program())
    done = subprocess.run(
        [sys.executable, '-IS', str(path), 'fly'], capture_output=True, timeout=30)
    assert done.returncode == 2 and done.stderr.startswith(b'usage: ')
