# SPDX-License-Identifier: Apache-2.0
"""
The agent on a cloud machine: starts the nodes, keeps their log, ends the machine in time.

It runs on Python 3.10 or newer with only the standard library, before anything is installed. It
travels as one file, ``agent.py``, which :mod:`fogros2.agent_client.program` makes of the
modules, in this order:

- ``protocol``: the requests, and the checks of configurations;
- ``journal``: the events on disk;
- ``loop``: one thread that serves sockets and timers, and blocks on none of them;
- ``watchdog``: when the machine has to end, and heartbeats;
- ``processes``: commands as root, and watches;
- ``programs``: packages, executables and files that a node's spec names;
- ``nodes``: the nodes' processes, from their start to their end;
- ``server``: clients, their requests, and the command line.

A module may import the standard library, the modules before it, and types of ``fogros2.events``.
"""

#: The modules in reading order; the one file has them in this order.
MODULES = (
    'protocol', 'journal', 'loop', 'watchdog', 'processes', 'programs', 'nodes', 'server')
