# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes."""

from typing import Any

from rclpy.exceptions import RCLError
from rclpy.type_support import check_is_valid_msg_type
from rosidl_embedded import cdr


def serialize_message(message: Any) -> bytes:
    """Serialize a message: encapsulation header and CDR."""
    check_is_valid_msg_type(type(message))
    return bytes(cdr.serialize(message))


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    """
    Deserialize a message.

    :raises RCLError: if the bytes are no such message.
    """
    check_is_valid_msg_type(message_type)
    try:
        return cdr.deserialize(bytes(serialized_message), message_type)
    except ValueError as error:
        raise RCLError(f'failed to deserialize ROS message: {error}') from error
