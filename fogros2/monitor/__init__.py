# SPDX-License-Identifier: Apache-2.0
"""
Watching a deployment from a browser.

:mod:`~fogros2.monitor.bridge` is the program on the machine that speaks Foxglove's WebSocket
protocol, :mod:`~fogros2.monitor.definitions` tells viewers what messages look like, and
:mod:`~fogros2.monitor.gate` stands in front of it where others than the robot may come in.
"""
