# SPDX-License-Identifier: Apache-2.0
"""
What a machine needs, and how the machine gets it.

``inspection`` reads a machine's facts. ``locked`` has the pinned versions of the package index.
``wheels`` packs the robot's own distributions. ``workspace`` sends workspaces, ``dependencies``
names the packages that nodes declare, ``installer`` installs packages. ``modules`` names the
modules that programs import, ``programs`` checks that the programs of nodes exist, ``undeclared``
finds imports that nodes do not declare. ``bootstrap`` brings ROS 2, ``relocation`` sets up the
libraries of its wheels.
"""
