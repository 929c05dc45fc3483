# SPDX-License-Identifier: Apache-2.0
"""Declare and validate parameters of nodes, and run a node that does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import Any, TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from fogros2_examples.files import check_writable

Number = TypeVar('Number', int, float)


class BadParameter(ValueError):
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


def run(name: str, make: Callable[[], Any], turn: Callable[[Any], object] = rclpy.spin) -> None:
    """
    Create a node and run it until a signal; exit at once on an invalid parameter or file.

    :param turn: runs the node; may raise SystemExit.
    """
    rclpy.init()
    try:
        turn(make())
    except (BadParameter, OSError) as error:
        raise SystemExit(f'{name}: {error}') from error
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # rclpy's signal handler shuts rclpy down in its own thread; do not do it twice
    except RuntimeError:  # RCLError: the signal came before a message was published
        if rclpy.ok():
            raise
    except SystemExit:
        rclpy.try_shutdown()
        raise
