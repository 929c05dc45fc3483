# SPDX-License-Identifier: Apache-2.0
"""``make lint`` refuses phrases that are hard to read."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ROOT / 'tools' / 'phrases.py'

spec = importlib.util.spec_from_file_location('phrases', PROGRAM)
assert spec is not None and spec.loader is not None
phrases = importlib.util.module_from_spec(spec)
spec.loader.exec_module(phrases)


def refused(folder: Path, name: str, text: str) -> list[str]:
    (folder / name).write_text(text)
    return list(phrases.found(folder))


@pytest.mark.parametrize('text', [
    '"""Do. {} {}."""\n', "raise VpnError('{} {} x')\n", '# a {}\n    # {} b\n',
    "'a {} '\n    f'{} b'\n", 'a {}\n{} b\n'])
def test_phrase_is_refused(tmp_path, text):
    words = phrases.PHRASES[1].capitalize().split()
    (line,) = refused(tmp_path, 'a.py', text.format(*words))
    assert line.startswith('a.py:1: ') and all(word in line for word in words)


@pytest.mark.parametrize('text', ['this told', 'retake it that', 'is_told', 'what is asked'])
def test_other_words_are_not_refused(tmp_path, text):
    assert refused(tmp_path, 'a.py', f'# {text}\n') == []


@pytest.mark.parametrize('length, refusals', [(60, 0), (61, 1)])
def test_long_name_of_a_test_is_refused(tmp_path, length, refusals):
    name = 'test_'.ljust(length, 'x')
    text = f'class TestIt:\n    async def {name}(self):\n        pass\n'
    assert refused(tmp_path, 'page.md', text) == []
    assert len(refused(tmp_path, 'a.py', text)) == refusals


def test_lint_fails_on_a_phrase(tmp_path):
    run = [sys.executable, str(PROGRAM), str(tmp_path)]
    (tmp_path / 'a.py').write_text('# clean\n')
    assert subprocess.run(run).returncode == 0
    (tmp_path / 'a.py').write_text(f'# {phrases.PHRASES[0]}\n')
    found = subprocess.run(run, capture_output=True, text=True)
    assert (found.returncode, found.stdout.count('\n')) == (1, 1)
    assert 'tools/phrases.py' in (ROOT / 'tools/lint.sh').read_text()
