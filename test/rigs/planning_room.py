# SPDX-License-Identifier: Apache-2.0
"""A room for the tests of motion planning."""

from __future__ import annotations

import numpy

from fogros2_examples.meshes import box, joined
from fogros2_examples.planning.scene import pose, Scene


def box_room(wall: bool) -> Scene:
    """Return a room 4 m long; ``wall`` says whether a wall closes its middle."""
    walls = joined([box((1.9, -1, -1), (2.1, 3, 3))] if wall else [box((1.9, 1, 0), (2.1, 2, 2))])
    return Scene('room', box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)), walls, joined([]),
                 numpy.zeros(3), numpy.array([4.0, 2.0, 2.0]), pose(0.5, 0.5, 0.5),
                 pose(3.5, 0.5, 0.5))
