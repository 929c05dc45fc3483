# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes that are looked at before anything is done with them."""

from __future__ import annotations

from collections.abc import Sequence
import math
import os
from pathlib import Path
from typing import TypeVar

from rclpy.node import Node

Number = TypeVar('Number', int, float)
#: What OpenCV, and matplotlib, draw into.
PICTURES = ('.png', '.jpg', '.jpeg')


class BadParameter(ValueError):
    """A parameter is none that a node can take; the text says which, and why."""


def within(
    node: Node, name: str, default: Number, least: float, most: float = math.inf,
) -> Number:
    """
    Declare a parameter and return its value, of the default's type.

    :raises BadParameter: it is less, or more, or no number.
    """
    value = node.declare_parameter(name, default).value
    if not least <= value <= most:
        limits = f'{least:g} at least' if most == math.inf else f'from {least:g} to {most:g}'
        raise BadParameter(f"'{name}' is {value:g}: it has to be {limits}")
    return type(default)(value)


def writable(node: Node, name: str, endings: Sequence[str] = ()) -> str:
    """
    Declare a parameter that names a file to write; return it, '' for none.

    :param endings: which names of such a file may have, any if there are none.
    :raises BadParameter: it can't be written.
    """
    text = str(node.declare_parameter(name, '').value)
    path = Path(text)
    if not text:
        return ''
    if endings and path.suffix.lower() not in endings:
        raise BadParameter(f"'{name}' is {path}: it has to end in {', '.join(endings)}")
    if not path.parent.is_dir():
        raise BadParameter(f"'{name}' is {path}: there is no folder {path.parent}")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise BadParameter(f"'{name}' is {path}: it can't be written")
    return text
