# SPDX-License-Identifier: Apache-2.0
"""Hand triangle meshes to FCL, which detects collisions."""

from __future__ import annotations

import fcl

from fogros2_examples.meshes import Mesh


def solid(mesh: Mesh) -> fcl.CollisionObject:
    """Return a mesh as an object of FCL."""
    model = fcl.BVHModel()
    model.beginModel(len(mesh.triangles), len(mesh.vertices))
    model.addSubModel(mesh.vertices, mesh.triangles)
    model.endModel()
    return fcl.CollisionObject(model, fcl.Transform())
