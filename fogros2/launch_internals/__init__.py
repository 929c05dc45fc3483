# SPDX-License-Identifier: Apache-2.0
"""
The private parts of launch and launch_ros that FogROS2 uses; no other package uses any.

In reading order: ``private`` has the parts of process actions and of the launch service, and lists
the processes of a launch, ``wrapping`` applies a function to all entities of some content,
``components`` renames topics of composable nodes, ``parsers`` changes elements of XML and YAML for
a part of a file, ``environment`` records the variables that launch files set, and ``hints``
improves errors.
"""
