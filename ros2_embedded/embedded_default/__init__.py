# SPDX-License-Identifier: Apache-2.0
"""What FogROS2's launch and ros2 share where ROS 2 is not installed: errors for missing parts."""
