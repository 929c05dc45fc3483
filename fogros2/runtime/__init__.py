# SPDX-License-Identifier: Apache-2.0
"""
The robot's side of a launch on launch's event loop: machines and remote processes.

In reading order: ``log_files`` limits launch's log files and survives a full disk, ``console``
shows steps, ``cost`` formats prices, ``signals`` makes SIGTERM an orderly shutdown, ``node_spec``
converts a process action to a NodeSpec, ``parts`` has what features do in the launch,
``added_process`` the processes that FogROS2 adds, ``backlog`` holds a machine's events until
launch takes them, ``run_state`` decides what follows for one process on a machine, ``remote_run``
connects it with launch, ``interruption`` has the event of a machine that ends early, ``session``
is a machine of the launch, ``coordinator`` connects the launch with its machines, and
``remote_process`` is the action of a remote process.
"""
