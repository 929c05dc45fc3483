# SPDX-License-Identifier: Apache-2.0
"""Callbacks for single parameters of other nodes, which the embedded default doesn't have."""

from rclpy.exceptions import NotEmbeddedError

raise NotEmbeddedError('rclpy.parameter_event_handler')
