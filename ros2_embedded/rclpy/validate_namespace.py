# SPDX-License-Identifier: Apache-2.0
"""Validation of names."""

from typing import Literal

from rclpy._names import namespace_fault
from rclpy.exceptions import InvalidNamespaceException


def validate_namespace(namespace: str) -> Literal[True]:
    """
    Check a name.

    :raises InvalidNamespaceException: if it is invalid.
    """
    fault = namespace_fault(namespace)
    if fault is not None:
        raise InvalidNamespaceException(namespace, *fault)
    return True
