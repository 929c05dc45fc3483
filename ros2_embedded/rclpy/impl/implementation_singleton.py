# SPDX-License-Identifier: Apache-2.0
"""What programs look for in ROS 2's extension module."""

from types import SimpleNamespace

from rclpy import exceptions

rclpy_implementation = SimpleNamespace(
    RCLError=exceptions.RCLError,
    RCLInvalidROSArgsError=exceptions.RCLInvalidROSArgsError,
    UnknownROSArgsError=exceptions.UnknownROSArgsError,
    InvalidHandle=exceptions.InvalidHandle,
    NodeNameNonExistentError=exceptions.NodeNameNonExistentError,
    UnsupportedEventTypeError=exceptions.UnsupportedEventTypeError,
    rclpy_get_rmw_implementation_identifier=lambda: 'rmw_cyclonedds_cpp',
)
