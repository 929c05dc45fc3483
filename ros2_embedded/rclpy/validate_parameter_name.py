# SPDX-License-Identifier: Apache-2.0
"""Validation of parameters' names."""

from typing import Literal

from rclpy.exceptions import InvalidParameterException


def validate_parameter_name(name: str) -> Literal[True]:
    """
    Check a name.

    :raises InvalidParameterException: if it is empty.
    """
    if not name:
        raise InvalidParameterException(name)
    return True
