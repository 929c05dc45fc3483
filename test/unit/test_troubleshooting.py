# SPDX-License-Identifier: Apache-2.0
"""Each error says what to do, in its hint or by its kind in doc/troubleshooting.md."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
import re

from fogros2 import errors

ROOT = Path(__file__).parents[2]
PACKAGES = ('fogros2', 'fogros2_monitor', 'ros2fog_cli')
#: Kinds whose remedy depends on what is wrong, so each message brings its own.
OWN_REMEDY = ('AuthenticationError', 'ConfigurationError', 'NameTaken', 'PrerequisiteError',
              'StoreError', 'WorkspaceError')


def calls() -> Iterator[tuple[str, ast.Call]]:
    """Yield file and line, and the call, of each error that brings its own remedy."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob('*.py')):
            if 'testing' in path.parts:
                continue  # no user sees these
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) \
                        and node.func.id in OWN_REMEDY and node.args:
                    yield f'{path.relative_to(ROOT)}:{node.lineno}', node


def test_kind_without_hints_has_a_remedy_on_the_page() -> None:
    kinds = {name for name, value in vars(errors).items()
             if isinstance(value, type) and issubclass(value, errors.FogError)}
    page = (ROOT / 'doc/troubleshooting.md').read_text()
    rows = re.findall(r'^\| `(\w+)` \| .+ \|$', page.partition('\n| Kind |')[2], re.MULTILINE)
    assert sorted(rows) == sorted(kinds - {'FogError', *OWN_REMEDY})


def test_error_of_a_kind_without_remedy_has_a_hint() -> None:
    places = dict(calls())
    assert len(places) > 200
    hintless = []
    for place, node in places.items():
        hint = node.args[1] if len(node.args) > 1 else next(
            (word.value for word in node.keywords if word.arg == 'hint'), None)
        if hint is None or isinstance(hint, ast.Constant) and not hint.value:
            hintless.append(place)
    assert hintless == []
