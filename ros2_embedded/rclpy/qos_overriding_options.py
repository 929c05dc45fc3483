# SPDX-License-Identifier: Apache-2.0
"""Parameters that change quality of service, which the embedded default doesn't have."""

from rclpy.exceptions import NotEmbeddedError

raise NotEmbeddedError('rclpy.qos_overriding_options')
