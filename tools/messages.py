# SPDX-License-Identifier: Apache-2.0
"""
Write the table of all error messages into doc/troubleshooting.md.

    python tools/messages.py [--check]

Messages and hints are read from the places that create an error of ``fogros2/errors.py``. The rest
of the page is written by hand: the table of kinds has the causes, and the remedies of messages
without a hint.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
import dataclasses
import functools
from pathlib import Path
import re
import sys

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / 'doc' / 'troubleshooting.md'
PACKAGES = ('fogros2', 'fogros2_monitor', 'ros2fog_cli')
#: Packages whose errors no user sees.
LEFT_OUT = ('testing',)
BEGIN = '<!-- messages: written by tools/messages.py -->'
END = '<!-- end of messages -->'
#: Replaces each value that is known only at run time.
OPEN = '…'


@dataclasses.dataclass(frozen=True, order=True)
class Message:
    """
    One error that can be raised.

    :param kind: its class.
    :param text: the message, with OPEN in the place of each value.
    :param hint: the remedy, '' where the error has none of its own.
    :param place: file and line of the call.
    """

    kind: str
    text: str
    hint: str
    place: str = dataclasses.field(compare=False)


def kinds() -> list[str]:
    """Return the classes of the tree in fogros2/errors.py, in its order."""
    tree = ast.parse((ROOT / 'fogros2' / 'errors.py').read_text())
    return [node.name for node in tree.body if isinstance(node, ast.ClassDef)]


def remedies(page: str) -> dict[str, tuple[str, str]]:
    """Return cause and remedy of each kind of error, from the page's table of kinds."""
    table = page.partition('\n| Kind |')[2].partition('\n\n')[0]
    return {kind: (why, remedy) for kind, why, remedy in re.findall(
        r'^\| `(\w+)` \| (.*?) \| (.*?) \|$', table, re.MULTILINE)}


@functools.cache
def messages() -> list[Message]:
    """Return all messages, sorted."""
    known = set(kinds())
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob('*.py')):
            if not set(LEFT_OUT) & set(path.parts):
                found += list(_in_file(path, known))
    return sorted(found)


@functools.cache
def tree(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


def _in_file(path: Path, known: set[str]) -> Iterator[Message]:
    for node in ast.walk(tree(path)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        if node.func.id not in known or not node.args or node.func.id == 'CommandError':
            continue
        hint: ast.expr | None = node.args[1] if len(node.args) > 1 else next(
            (keyword.value for keyword in node.keywords if keyword.arg == 'hint'), None)
        yield Message(node.func.id, _text(node.args[0]), _text(hint) if hint is not None else '',
                      f'{path.relative_to(ROOT)}:{node.lineno}')


def _text(node: ast.expr) -> str:
    """Return the text of an expression, with OPEN for each part that is not constant."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return ''.join(_text(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    if isinstance(node, (ast.IfExp, ast.BoolOp)):
        choices = [node.body, node.orelse] if isinstance(node, ast.IfExp) else node.values
        said = [text for text in map(_text, choices) if text not in ('', OPEN)]
        return ' / '.join(dict.fromkeys(said)) or OPEN
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) \
            and node.func.id == 'did_you_mean':
        others = [_text(node.args[2])] if len(node.args) > 2 else [f'there are: {OPEN}']
        return ' / '.join([f"did you mean '{OPEN}'?", *others])
    return OPEN


def render(page: str) -> str:
    """Return the table of all messages; those without a hint have the remedy of their kind."""
    rows = set()
    kind = remedies(page)
    for one in messages():
        if re.search(r'\w{3}', one.text):
            why, remedy = kind[one.kind]
            if one.hint not in ('', OPEN):
                remedy = _plain(one.hint)
            rows.add(f'| `{_cell(_code(one.text))}` | {why} | {remedy} |')
    return '\n'.join([BEGIN, '', '| Message | Why | Remedy |', '|---|---|---|',
                      *sorted(rows, key=_letters), '', END])


def _letters(row: str) -> tuple[str, str]:
    """Return the key to sort by: a reader looks for the first word that the source has."""
    return ''.join(re.findall(r'[a-z0-9 ]+', row.lower())).strip(), row


def _cell(text: str) -> str:
    return text.replace('|', r'\|')


def _code(text: str) -> str:
    return ' '.join(text.replace('`', "'").split())


def _plain(text: str) -> str:
    """Return a text with the special characters of Markdown escaped."""
    return re.sub(r'([\\*_<>\[\]|#])', r'\\\1', _code(text))


def main() -> int:
    """Write the page; with --check, only report whether it would change."""
    before = DOCUMENT.read_text()
    begin, end = before.index(BEGIN), before.index(END) + len(END)
    after = before[:begin] + render(before) + before[end:]
    if '--check' not in sys.argv:
        DOCUMENT.write_text(after)
    elif after != before:
        print(f'{DOCUMENT.relative_to(ROOT)} is not up to date: python tools/messages.py')
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
