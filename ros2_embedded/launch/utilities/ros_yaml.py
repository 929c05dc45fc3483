# SPDX-License-Identifier: Apache-2.0
"""
YAML with the types that rcl gives to scalars without quotes.

PyYAML reads 1e-3 as a text, 12:30 as a number and y as a text; rcl decides otherwise.
"""
from __future__ import annotations

import contextlib
import functools
import math
import re
import sys
from typing import Any

_TRUE = {'y', 'Y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON'}
_FALSE = {'n', 'N', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF'}
#: What strtol reads with base 0.
_INT = re.compile(r'[-+]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)')
#: What strtod reads, and YAML's names for infinity and no number.
_FLOAT = re.compile(r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?'
                    r'|[-+]?(?i:inf|infinity|nan)|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)')
_HEX_FLOAT = re.compile(r'(?i:[-+]?0x([0-9a-f]+\.?[0-9a-f]*|\.[0-9a-f]+)(p[-+]?[0-9]+)?)')
_TEXT = 'tag:yaml.org,2002:str'


def typed(text: str) -> bool | int | float | str:
    """Return the value of a scalar without quotes."""
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if _INT.fullmatch(text):
        digits = text.lstrip('-+')
        base = 16 if digits[1:2] in ('x', 'X') else 8 if digits[0] == '0' else 10
        number = int(text, base)
        if -1 << 63 <= number < 1 << 63:
            return number
    if _FLOAT.fullmatch(text):
        found = float(text if text[-1].isdigit() else text.replace('.', ''))
        mantissa = re.split('[eE]', text)[0] if text[-1].isdigit() else ''
        # rcl takes a number out of range for a text
        if not re.search('[1-9]', mantissa) or sys.float_info.min <= abs(found) < math.inf:
            return found
    if _HEX_FLOAT.fullmatch(text):
        with contextlib.suppress(OverflowError):
            return float.fromhex(text)
    return text


class Plain(str):
    """A text without quotes that rcl takes for a value of another type, and PyYAML does not."""


class Mapping(dict[Any, Any]):
    """A mapping that knows its line in the file."""

    line: int


@functools.cache
def _classes() -> tuple[Any, Any, Any]:
    import yaml

    def resolvers(*kinds: str) -> dict[Any, Any]:
        known = yaml.SafeLoader.yaml_implicit_resolvers
        return {first: [pair for pair in pairs if pair[0].rpartition(':')[2] in kinds]
                for first, pairs in known.items()}

    class Loader(yaml.SafeLoader):

        yaml_implicit_resolvers = resolvers('merge')

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            self.flatten_mapping(node)
            for name, _ in node.value:
                name.style = '"'  # Names are texts, y too.
            found: dict[Any, Any] = super().construct_mapping(node, deep)
            return found

        def construct_text(self, node: Any) -> Any:
            text = self.construct_scalar(node)
            return typed(text) if node.style is None else text

    class LaunchFileLoader(yaml.SafeLoader):

        yaml_implicit_resolvers = resolvers('bool', 'merge', 'null')

        def construct_text(self, node: Any) -> Any:
            text = self.construct_scalar(node)
            value = typed(text) if node.style is None else text
            if value == text or '.' in text or type(value) is int:
                return value
            return Plain(text)

        def construct_map(self, node: Any) -> Any:
            found = Mapping()
            found.line = node.start_mark.line + 1
            yield found  # Aliases inside may mean the mapping itself.
            found.update(self.construct_mapping(node))

    class Dumper(yaml.SafeDumper):

        def represent_text(self, text: str) -> Any:
            return self.represent_scalar(_TEXT, text, style='"')

    for loader in (Loader, LaunchFileLoader):
        loader.add_constructor(_TEXT, loader.construct_text)
    LaunchFileLoader.add_constructor('tag:yaml.org,2002:map', LaunchFileLoader.construct_map)
    Dumper.add_representer(str, Dumper.represent_text)
    return Loader, LaunchFileLoader, Dumper


def load(text: str) -> Any:
    """
    Read YAML.

    :raises yaml.YAMLError: with line and column.
    """
    import yaml
    return yaml.load(text, _classes()[0])  # noqa: S506 - a SafeLoader


def load_launch_file(file: Any) -> Any:
    """
    Read YAML as launch files have it: y and 1e-3 are names too, and become :class:`Plain`.

    :return: its mappings are each a :class:`Mapping`.

    :raises yaml.YAMLError: with line and column.
    """
    import yaml
    return yaml.load(file, _classes()[1])  # noqa: S506 - a SafeLoader


def dump(value: Any) -> str:
    """Write a value in one line; texts have quotes, so that they stay texts."""
    import yaml
    return str(yaml.dump(value, Dumper=_classes()[2], default_flow_style=True,
                         width=math.inf, allow_unicode=True)).partition('\n')[0]
