# SPDX-License-Identifier: Apache-2.0
"""Options for other ros2 commands."""
