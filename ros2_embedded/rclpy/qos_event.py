# SPDX-License-Identifier: Apache-2.0
"""The older name of :mod:`rclpy.event_handler`."""

from rclpy.event_handler import *  # noqa: F403
