# SPDX-License-Identifier: Apache-2.0
"""Checks of interface classes."""

from typing import Any

from rclpy.exceptions import NoTypeSupportImportedException


def check_for_type_support(msg_or_srv_type: Any) -> None:
    """
    Check that it is the class of a message or a service.

    :raises NoTypeSupportImportedException: if it isn't.
    """
    if not hasattr(msg_or_srv_type, '_service'):
        check_is_valid_msg_type(msg_or_srv_type)


def check_is_valid_msg_type(msg_type: Any) -> None:
    """
    Check that it is a message's class.

    :raises NoTypeSupportImportedException: if it isn't.
    """
    if not isinstance(msg_type, type) or not hasattr(msg_type, '_definition'):
        raise NoTypeSupportImportedException()


def check_is_valid_srv_type(srv_type: Any) -> None:
    """
    Check that it is a service's class.

    :raises NoTypeSupportImportedException: if it isn't.
    """
    if not isinstance(srv_type, type) or not hasattr(srv_type, '_service'):
        raise NoTypeSupportImportedException()
