# SPDX-License-Identifier: Apache-2.0
"""Transport images as H.264: ``codec`` without ROS, and the nodes ``encoder`` and ``decoder``."""
