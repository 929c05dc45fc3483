# SPDX-License-Identifier: Apache-2.0
"""
Writes what FogROS2's errors say, and what to do, into doc/troubleshooting.md.

    python tools/messages.py [--check]

The texts are the sources' own: every place that makes an error of ``fogros2/errors.py``. What
stands by hand in the document, the part on each kind of error among it, is left as it is.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
import dataclasses
from pathlib import Path
import re
import sys

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / 'doc' / 'troubleshooting.md'
PACKAGES = ('fogros2', 'ros2fog_cli')
#: What users of a package never meet.
LEFT_OUT = ('testing',)
BEGIN = '<!-- messages: written by tools/messages.py -->'
END = '<!-- end of messages -->'
#: Stands for what is known when it happens.
OPEN = '…'


@dataclasses.dataclass(frozen=True, order=True)
class Message:
    """
    One error that can be raised.

    :param kind: its class.
    :param text: what it says; OPEN stands for what isn't in the source.
    :param hint: what to do, '' where that is said of the kind.
    :param place: file and line, for whoever looks after the sources.
    """

    kind: str
    text: str
    hint: str
    place: str = dataclasses.field(compare=False)


def kinds() -> list[str]:
    """Return the classes of the tree in fogros2/errors.py, in its order."""
    tree = ast.parse((ROOT / 'fogros2' / 'errors.py').read_text())
    return [node.name for node in tree.body if isinstance(node, ast.ClassDef)]


def messages() -> list[Message]:
    """Return all messages, sorted."""
    known = set(kinds())
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob('*.py')):
            if not set(LEFT_OUT) & set(path.parts):
                found += list(_in_file(path, known))
    return sorted(found)


def _in_file(path: Path, known: set[str]) -> Iterator[Message]:
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        if node.func.id not in known or not node.args or node.func.id == 'CommandError':
            continue
        hint: ast.expr | None = node.args[1] if len(node.args) > 1 else next(
            (keyword.value for keyword in node.keywords if keyword.arg == 'hint'), None)
        yield Message(node.func.id, _text(node.args[0]), _text(hint) if hint is not None else '',
                      f'{path.relative_to(ROOT)}:{node.lineno}')


def _text(node: ast.expr) -> str:
    """Return what an expression says, as far as the source tells."""
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
    return OPEN


def render() -> str:
    """Return the lines of the document that are written by this program."""
    lines = []
    every = messages()
    for kind in kinds():
        own = {(one.text, one.hint) for one in every if one.kind == kind
               and re.search(r'\w{3}', one.text)}
        if own:
            lines += ['', f'**{kind}**', '']
            for text, hint in sorted(own):
                remedy = '' if hint in ('', OPEN) else f': {_plain(hint)}'
                lines.append(f'- `{_code(text)}`{remedy}')
    return '\n'.join([BEGIN, *lines, '', END])


def _code(text: str) -> str:
    return ' '.join(text.replace('`', "'").split())


def _plain(text: str) -> str:
    """Return a text that Markdown shows as it is."""
    return re.sub(r'([\\*_<>\[\]|#])', r'\\\1', _code(text))


def main() -> int:
    """Write the document, or with --check only say whether it would change."""
    before = DOCUMENT.read_text()
    begin, end = before.index(BEGIN), before.index(END) + len(END)
    after = before[:begin] + render() + before[end:]
    if '--check' not in sys.argv:
        DOCUMENT.write_text(after)
    elif after != before:
        print(f'{DOCUMENT.relative_to(ROOT)} is not up to date: python tools/messages.py')
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
