# SPDX-License-Identifier: Apache-2.0
"""Validation of topics' and services' names."""

from typing import Literal

from rclpy._names import full_topic_name_fault
from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException

TOPIC_SEPARATOR_STRING = '/'


def validate_full_topic_name(name: str, *, is_service: bool = False) -> Literal[True]:
    """
    Check a name.

    :raises InvalidTopicNameException: if it is invalid; for a service its own exception.
    """
    fault = full_topic_name_fault(name)
    if fault is not None:
        kind = InvalidServiceNameException if is_service else InvalidTopicNameException
        raise kind(name, *fault)
    return True
