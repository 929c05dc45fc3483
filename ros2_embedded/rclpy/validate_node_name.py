# SPDX-License-Identifier: Apache-2.0
"""Validation of names."""

from typing import Literal

from rclpy._names import node_name_fault
from rclpy.exceptions import InvalidNodeNameException


def validate_node_name(node_name: str) -> Literal[True]:
    """
    Check a name.

    :raises InvalidNodeNameException: if it is invalid.
    """
    fault = node_name_fault(node_name)
    if fault is not None:
        raise InvalidNodeNameException(node_name, *fault)
    return True
