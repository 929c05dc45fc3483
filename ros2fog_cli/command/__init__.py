# SPDX-License-Identifier: Apache-2.0
"""The command extension of ros2cli."""
