# SPDX-License-Identifier: Apache-2.0
"""doc/troubleshooting.md has every error there is, with what to do."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path
import re
import sys

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / 'doc' / 'troubleshooting.md').read_text()
PROGRAM = ROOT / 'tools' / 'messages.py'

spec = importlib.util.spec_from_file_location('messages', PROGRAM)
assert spec is not None and spec.loader is not None
messages = importlib.util.module_from_spec(spec)
sys.modules['messages'] = messages
spec.loader.exec_module(messages)

#: Kinds whose remedy depends on what is wrong, so each message brings its own.
OWN_REMEDY = ('AuthenticationError', 'ConfigurationError', 'NameTaken', 'PrerequisiteError',
              'StoreError', 'WorkspaceError')


def test_each_kind_of_error_has_a_remedy() -> None:
    assert set(messages.remedies(DOCUMENT)) == set(messages.kinds()) - {'FogError'}


def test_message_of_a_kind_without_remedy_has_a_hint() -> None:
    assert [f'{one.place}: {one.text}' for one in messages.messages()
            if one.kind in OWN_REMEDY and not one.hint] == []


def test_row_has_message_cause_and_remedy() -> None:
    table = DOCUMENT[DOCUMENT.index(messages.BEGIN):]
    rows = re.findall(r'^\| `[^`]+` \| ([^|]+) \| (.+) \|$', table, re.MULTILINE)
    assert len(rows) == len(re.findall(r'^\| `', table, re.MULTILINE)) > 300


def test_page_is_up_to_date(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, 'argv', [str(PROGRAM), '--check'])
    assert messages.main() == 0, capsys.readouterr().out
    assert len(messages.messages()) > 300


def test_message_in_an_expression_is_found(tmp_path: Path) -> None:
    source = tmp_path / 'a.py'
    source.write_text("raise VpnError(f'{x} is away' + (' again' if y else ''), hint='go ' + z)\n")
    messages_of = messages._in_file
    messages.ROOT, before = tmp_path, messages.ROOT
    try:
        (one,) = messages_of(source, {'VpnError'})
    finally:
        messages.ROOT = before
    assert (one.text, one.hint, one.place) == ('… is away again', 'go …', 'a.py:1')


def test_quoted_messages_are_in_the_source() -> None:
    """Rows that begin with a message have it in the words of the source."""
    said = {
        messages._text(node) for package in (*messages.PACKAGES, 'packaging')
        for path in (ROOT / package).rglob('*.py')
        for node in ast.walk(messages.tree(path))
        if isinstance(node, (ast.Constant, ast.JoinedStr))}
    table = DOCUMENT[:DOCUMENT.index('## Kinds of errors')]
    rows = re.findall(r'^\| `([^`]+)`', table, re.MULTILINE)
    assert rows
    for row in rows:
        if not row.startswith('ros2 '):  # a command, not a message
            assert any(_is_like(row, text) for text in said), row


def _is_like(row: str, text: str) -> bool:
    """Return whether most of a row is a text's own words, in their order."""
    parts = [part for part in text.split(messages.OPEN) if part]
    if sum(map(len, parts)) <= len(row) / 2 or not all(part in row for part in parts):
        return False  # a regular expression takes longer
    pattern = '.*'.join(map(re.escape, parts))
    return re.search(pattern, row) is not None
