# SPDX-License-Identifier: Apache-2.0
"""Waitables of one's own, based on rcl's wait sets, which the embedded default doesn't have."""

from rclpy.exceptions import NotEmbeddedError

raise NotEmbeddedError('rclpy.waitable')
