# SPDX-License-Identifier: Apache-2.0
"""
Serve a web page on this computer's loopback interface that shows a deployment live.

:mod:`~fogros2_monitor.dashboard.server` serves the page and its data.
:mod:`~fogros2_monitor.dashboard.graph` runs a node in the ROS graph of a launch; the node counts
messages and takes pictures while somebody watches.
"""
