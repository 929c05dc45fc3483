# SPDX-License-Identifier: Apache-2.0
"""
Machines as launch files describe them: keywords and values that become a MachineSpec.

In reading order: ``values`` resolves substitutions, ``names`` generates names, ``variables`` keeps
the robot's own variables here, ``kinds`` reads the annotations of constructors, ``features`` those
of features, ``choices`` requests a region or a type, ``machines`` and ``machines_cloud`` have the
classes of machines, ``keywords`` reads their arguments from text, ``overrides`` reads
``--machine``, and ``defaults`` reads the files of the user and the workspace.
"""
