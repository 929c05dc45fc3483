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

In launch files: :mod:`~fogros2_monitor.feature` has the keywords of machines
(:mod:`~fogros2_monitor.networks`), :mod:`~fogros2_monitor.action` the action ``Foxglove``, which
starts the bridge (:mod:`~fogros2_monitor.addresses`). :mod:`~fogros2_monitor.verbs` has the verbs
of ``ros2 fog``, :mod:`~fogros2_monitor.access` reads a machine's token for them, and
:mod:`~fogros2_monitor.browser` starts a browser.

``fogros2`` and ``ros2fog_cli`` do not import this package. They find the program below by the
entry-point group ``fogros2.monitor``.
"""

from fogros2.python_module import RUN_MODULE

#: Command that prints the topics of a launch, see :mod:`~fogros2_monitor.dashboard.graph`.
GRAPH = (*RUN_MODULE, 'fogros2_monitor.dashboard.graph')
