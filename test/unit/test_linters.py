# SPDX-License-Identifier: Apache-2.0
"""The linters are tests: what `make lint` says holds for what is tested."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]


def run(tool: str, *words: str, cwd: Path = ROOT) -> None:
    if importlib.util.find_spec(tool) is None:
        pytest.skip(f'{tool} is not installed in this interpreter')
    done = subprocess.run([sys.executable, '-m', tool, *words], cwd=cwd, text=True,
                          capture_output=True)
    assert done.returncode == 0, f'{done.stdout}\n{done.stderr}'


def test_ruff() -> None:
    run('ruff', 'check', '.')


@pytest.mark.timeout(600)
def test_mypy_of_the_core() -> None:
    run('mypy')


@pytest.mark.timeout(600)
def test_mypy_of_the_embedded_default() -> None:
    run('mypy', '--config-file', '../pyproject.toml', '--exclude', '^(test/|build/|setup.py)', '.',
        cwd=ROOT / 'ros2_embedded')
