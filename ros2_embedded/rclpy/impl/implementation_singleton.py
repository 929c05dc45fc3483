# SPDX-License-Identifier: Apache-2.0
"""ROS 2's extension module, which the embedded default doesn't have."""

from rclpy.exceptions import NotEmbeddedError

raise NotEmbeddedError('rclpy.impl.implementation_singleton')
