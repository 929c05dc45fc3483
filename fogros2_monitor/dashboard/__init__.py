# SPDX-License-Identifier: Apache-2.0
"""
A page on this computer's loopback that shows a deployment as it goes on.

:mod:`~fogros2_monitor.dashboard.server` serves it and what it asks for,
:mod:`~fogros2_monitor.dashboard.graph` runs a node beside a launch that counts messages and takes
pictures while somebody looks.
"""
