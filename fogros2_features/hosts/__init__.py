# SPDX-License-Identifier: Apache-2.0
"""
Container machines of several robots on one computer, their host.

``served`` is the program on the host, and ``hosted`` the robot's end of it.
"""
