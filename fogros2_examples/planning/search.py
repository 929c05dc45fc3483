# SPDX-License-Identifier: Apache-2.0
"""Search for a motion: OMPL searches, FCL detects collisions of the body."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import time
from typing import Any, Literal, Union

import fcl
import numpy
import ompl.base
import ompl.geometric
import ompl.util

from fogros2_examples.collisions import solid
from fogros2_examples.meshes import Floats, joined, rotation
from fogros2_examples.planning.scene import Scene

#: OMPL's planners between two poses.
PLANNERS = ('RRTConnect', 'LBKPIECE1', 'KPIECE1', 'RRT', 'BKPIECE1')
#: Maximum motion of a point of the body between two collision checks, by translation and by
#: rotation, as a share of the diagonal of the bounds.
RESOLUTION = 0.002
End = Literal['found', 'start', 'goal', 'time']
Numbers = Union[Floats, tuple[float, ...]]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """
    The result of a search.

    :param end: 'found'; 'start' or 'goal': that pose collides or is out of bounds; 'time': the
        time-out was over.
    :param path: n poses of 7 numbers as in Scene, start to goal; empty unless found. Between two
        poses, the body moves straight and turns the shorter way, both at a constant rate.
    :param length: length of the path, m.
    :param checks: number of collision checks.
    :param seconds: duration of the search.
    """

    end: End
    path: list[list[float]]
    length: float
    checks: int
    seconds: float


class Space:
    """The space of poses of a scene's body, with the data that searches share."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.checks = 0
        self._body = solid(scene.body)
        self._walls = solid(joined([scene.walls, scene.shell]))
        self._request = fcl.CollisionRequest()
        ompl.util.setLogLevel(ompl.util.LOG_ERROR)
        self.states = ompl.base.SE3StateSpace()
        bounds = ompl.base.RealVectorBounds(3)
        for axis in range(3):
            bounds.setLow(axis, float(scene.low[axis]))
            bounds.setHigh(axis, float(scene.high[axis]))
        self.states.setBounds(bounds)
        self.states.setLongestValidSegmentFraction(RESOLUTION)
        # OMPL takes the same share of the largest rotation (of half the angle). That assumes a
        # body as large as the room, and is several times finer than the steps of translation.
        step = RESOLUTION * float(numpy.linalg.norm(scene.high - scene.low))
        radius = float(numpy.linalg.norm(scene.body.vertices, axis=1).max())
        turns = self.states.getSubspace(1)
        turns.setLongestValidSegmentFraction(
            step / (2 * max(radius, step) * turns.getMaximumExtent()))
        self._low, self._high = scene.low.tolist(), scene.high.tolist()

    def touches(self, position: Numbers, turn: Numbers) -> bool:
        """Return whether the body collides; ``turn`` is a matrix or a quaternion w, x, y, z."""
        self.checks += 1
        self._body.setTransform(fcl.Transform(turn, position))
        return bool(fcl.collide(self._body, self._walls, self._request, fcl.CollisionResult()))

    def free(self, pose: Floats) -> bool:
        """Return whether a pose is within bounds and without collision."""
        inside = (pose[:3] >= self.scene.low).all() and (pose[:3] <= self.scene.high).all()
        return bool(inside) and not self.touches(pose[:3], rotation(pose[3:]))

    def search(self, start: Floats, goal: Floats, *, seconds: float, seed: int = 1,
               planner: str = PLANNERS[0]) -> Outcome:
        """
        Search for a motion.

        :param seconds: time-out.
        :param seed: seed of the random numbers; the same seed finds the same motion. OMPL accepts
            a seed once per process: a second search continues the first one's random numbers.
        """
        begin, self.checks = time.monotonic(), 0

        def ended(end: End, path: Sequence[list[float]] = ()) -> Outcome:
            places = numpy.array(path).reshape(-1, 7)[:, :3]
            length = float(numpy.linalg.norm(numpy.diff(places, axis=0), axis=1).sum())
            return Outcome(end, [*path], length, self.checks, time.monotonic() - begin)

        if not self.free(start):
            return ended('start')
        if not self.free(goal):
            return ended('goal')
        ompl.util.RNG.setSeed(seed)
        setup = ompl.geometric.SimpleSetup(self.states)
        setup.setStateValidityChecker(self._valid)
        setup.setStartAndGoalStates(self._state(start), self._state(goal))
        space = setup.getSpaceInformation()
        setup.setPlanner(getattr(ompl.geometric, planner)(space))
        calls = 0

        def give_up() -> bool:
            nonlocal calls
            calls += 1
            return calls % 32 == 0 and time.monotonic() - begin > seconds

        setup.solve(ompl.base.PlannerTerminationCondition(give_up))
        if not setup.haveExactSolutionPath():
            return ended('time')
        path = setup.getSolutionPath()
        simplifier = ompl.geometric.PathSimplifier(space)
        # Limited by steps instead of time, so that a seed always finds the same path.
        simplifier.reduceVertices(path)
        simplifier.collapseCloseVertices(path)
        simplifier.partialShortcutPath(path)
        simplifier.reduceVertices(path)
        return ended('found', [_pose(state) for state in path.getStates()])

    def _valid(self, state: Any) -> bool:
        # Plain numbers, because arrays of three would take as long as FCL.
        turn, x, y, z = state.rotation(), state.getX(), state.getY(), state.getZ()
        (west, south, low), (east, north, high) = self._low, self._high
        return (west <= x <= east and south <= y <= north and low <= z <= high
                and not self.touches((x, y, z), (turn.w, turn.x, turn.y, turn.z)))

    def _state(self, pose: Floats) -> Any:
        state = self.states.allocState()
        state.setXYZ(*map(float, pose[:3]))
        turn = state.rotation()
        turn.x, turn.y, turn.z, turn.w = map(float, pose[3:] / numpy.linalg.norm(pose[3:]))
        return state


def _pose(state: Any) -> list[float]:
    turn = state.rotation()
    return [state.getX(), state.getY(), state.getZ(), turn.x, turn.y, turn.z, turn.w]
