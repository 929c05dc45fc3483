# SPDX-License-Identifier: Apache-2.0
"""
A policy on another machine: it sees the robot's cameras, and commands chunks of actions.

Pure: ``chunks`` (the robot's queue), ``matching`` (of stamps), ``arm``, ``training``,
``onnx_file``. ``policies`` runs models, ``messages`` converts. Nodes: ``policy_server`` on the
machine, ``policy_client`` on the robot, ``policy_arm`` in place of a robot, with ``picture``.
"""
