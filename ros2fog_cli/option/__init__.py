# SPDX-License-Identifier: Apache-2.0
"""Options of other commands of ros2."""
