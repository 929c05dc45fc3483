# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2``: ROS 2 Jazzy's API for commands and verbs."""
