# SPDX-License-Identifier: Apache-2.0
"""Where ROS 2 has this function; see :mod:`rclpy._names`."""

from rclpy._names import validate_namespace as validate_namespace
