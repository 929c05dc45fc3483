# SPDX-License-Identifier: Apache-2.0
"""Declare and validate parameters of nodes."""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import TypeVar

from rclpy.node import Node

from fogros2_examples.files import BadInput, check_writable

Number = TypeVar('Number', int, float)


class BadParameter(BadInput):
    """A parameter is invalid; the text has its name and the reason."""


def within(
    node: Node, name: str, default: Number, least: float, most: float = math.inf,
) -> Number:
    """
    Declare a numeric parameter, and return its value with the default's type.

    :raises BadParameter: the value is out of range.
    """
    value = node.declare_parameter(name, default).value
    if not least <= value <= most:
        limits = f'{least:g} at least' if most == math.inf else f'from {least:g} to {most:g}'
        raise BadParameter(f"'{name}' is {value:g}: it has to be {limits}")
    return type(default)(value)


def writable(node: Node, name: str, endings: Sequence[str] = ()) -> str:
    """
    Declare a parameter that names a file to write; return the name, '' for none.

    :param endings: allowed file extensions; empty: all.
    :raises BadParameter: the file cannot be written.
    """
    text = str(node.declare_parameter(name, '').value)
    try:
        if text:
            check_writable(text, endings)
    except ValueError as error:
        raise BadParameter(f"'{name}' is {text}: {error}") from error
    return text
