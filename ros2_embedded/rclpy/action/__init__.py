# SPDX-License-Identifier: Apache-2.0
"""Actions, which the embedded default doesn't have."""

from rclpy.exceptions import NotEmbeddedError

raise NotEmbeddedError('rclpy.action (actions)')
