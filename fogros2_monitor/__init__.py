# SPDX-License-Identifier: Apache-2.0
"""
Watch a deployment in a browser: the Foxglove bridge, its gate, and the dashboard; record it.

:mod:`~fogros2_monitor.serve` starts the bridge on a machine. :mod:`~fogros2_monitor.gate` admits
requests that have the token (:mod:`~fogros2_monitor.request`, :mod:`~fogros2_monitor.page`,
:mod:`~fogros2_monitor.credentials`) and come from no other account of the computer
(:mod:`~fogros2_monitor.accounts`). :mod:`~fogros2_monitor.bridge` implements Foxglove's
WebSocket protocol, :mod:`~fogros2_monitor.recorder` writes a file; both take messages from the
graph (:mod:`~fogros2_monitor.topics`), with the definitions of
:mod:`~fogros2_monitor.definitions`. For viewers, the bridge also calls services
(:mod:`~fogros2_monitor.services`), sets parameters (:mod:`~fogros2_monitor.parameters`) and reads
files of robot models (:mod:`~fogros2_monitor.assets`).
:mod:`~fogros2_monitor.application` runs the web application in a container.
:mod:`~fogros2_monitor.tunnel` and :mod:`~fogros2_monitor.urls` open the bridge on the robot.
:mod:`~fogros2_monitor.dashboard` is the page of ``ros2 fog dashboard``.

``fogros2`` does not import this package. It finds the two programs below by the entry-point group
``fogros2.monitor``.
"""

import sys

#: Package and executable that serve a machine's topics to Foxglove.
FOXGLOVE = ('fogros2', 'bridge')
#: Command that prints the topics of a launch, see :mod:`~fogros2_monitor.dashboard.graph`.
#: Without the current folder: it may have modules of other accounts.
GRAPH = (sys.executable, '-c', 'import sys; sys.path[:] = filter(None, sys.path); '
         'from fogros2_monitor.dashboard import graph; graph.main()')
