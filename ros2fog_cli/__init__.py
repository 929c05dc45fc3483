# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 fog``: verbs parse and print, ``api`` decides."""
