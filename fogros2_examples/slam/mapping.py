# SPDX-License-Identifier: Apache-2.0
"""
The map: keyframes with the points they see, and the pose graph that holds them together.

A point belongs to the keyframe that saw it first and is kept in its camera's frame: when the graph
moves keyframes, their points go with them. GTSAM optimises the graph.
"""

from __future__ import annotations

import dataclasses
from typing import Optional

import cv2
import gtsam
import numpy
from numpy.typing import NDArray

from fogros2_examples.slam import matching
from fogros2_examples.slam.features import Features
from fogros2_examples.slam.geometry import angle, Array, Camera, inverse, moved
from fogros2_examples.slam.pose import solve

#: How well one keyframe is known from another: radians, metres.
TURN, SHIFT = 0.004, 0.008
#: Descriptors by which a keyframe is recognised, and those of its that have to be found again.
TELLING, VOTES = 250, 20
#: Points that a keyframe has in common with another place of the map, to be at that place.
AGREEING = 40
#: Keyframes that are too near in time to be a place that one comes back to.
RECENT = 8
#: Measurements whose mean a point is at the most, so that it can still give way.
MOST = 20
#: Keyframes whose points are looked for at a time.
LOCAL = 12


@dataclasses.dataclass
class Keyframe:
    """
    A frame that is part of the map.

    :param points: (N, 3), of its features, in its camera's frame; nan without a depth.
    :param own: (N,), those that no keyframe before had.
    :param weights: (N,), of the measurements that the points are the means of.
    :param telling: indices of the features by which it is recognised.
    """

    number: int
    stamp: int
    pose: Array
    features: Features
    points: Array
    own: NDArray[numpy.bool_]
    weights: Array
    telling: NDArray[numpy.int64]
    links: set[int] = dataclasses.field(default_factory=set)


@dataclasses.dataclass(frozen=True)
class Points:
    """
    Points of the map, M of them.

    :param places: (M, 3), of the world.
    :param descriptors: (M, 32).
    :param keyframes: (M,), the number of that which they belong to; ``rows`` (M,), which of its.
    """

    places: Array
    descriptors: NDArray[numpy.uint8]
    keyframes: NDArray[numpy.int64]
    rows: NDArray[numpy.int64]


class Map:
    """Keyframes, in the order in which they came."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.keyframes: list[Keyframe] = []
        #: Places that were recognised so far.
        self.loops = 0
        self._factors = gtsam.NonlinearFactorGraph()
        self._noise = gtsam.noiseModel.Diagonal.Sigmas(numpy.array([TURN] * 3 + [SHIFT] * 3))
        # one wrong recognition must not bend the whole map
        self._wary = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Cauchy.Create(3.0), self._noise)

    def add(self, stamp: int, pose: Array, features: Features, known: NDArray[numpy.bool_],
            reference: Optional[Keyframe] = None) -> Keyframe:
        """
        Return a new keyframe, linked to the reference.

        :param known: (N,), features that are points of other keyframes.
        """
        points = self._camera.lift(features.pixels, features.depths)
        deep = numpy.flatnonzero(features.deep)
        keyframe = Keyframe(
            len(self.keyframes), stamp, pose, features, points, features.deep & ~known,
            weight(features.depths), deep[::max(1, len(deep) // TELLING)][:TELLING])
        self.keyframes.append(keyframe)
        if reference is None:
            self._factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(pose), self._noise))
        else:
            self._link(reference, keyframe, inverse(reference.pose) @ pose, self._noise)
        return keyframe

    def _link(self, one: Keyframe, two: Keyframe, between: Array,
              noise: gtsam.noiseModel.Base) -> None:
        self._factors.add(gtsam.BetweenFactorPose3(
            one.number, two.number, gtsam.Pose3(between), noise))
        one.links.add(two.number)
        two.links.add(one.number)

    def around(self, keyframe: Keyframe) -> list[Keyframe]:
        """Return a keyframe and those linked to it, the nearest first, not more than ``LOCAL``."""
        found, edge = {keyframe.number: None}, [keyframe.number]
        while edge and len(found) < LOCAL:
            edge = [other for number in edge for other in sorted(
                self.keyframes[number].links, reverse=True) if other not in found]
            found.update(dict.fromkeys(edge))
        return [self.keyframes[number] for number in list(found)[:LOCAL]]

    @staticmethod
    def points(keyframes: list[Keyframe]) -> Points:
        """Return the points that keyframes have of their own."""
        return Points(
            numpy.concatenate([moved(k.pose, k.points[k.own]) for k in keyframes]),
            numpy.concatenate([k.features.descriptors[k.own] for k in keyframes]),
            numpy.concatenate([numpy.full(k.own.sum(), k.number) for k in keyframes]),
            numpy.concatenate([numpy.flatnonzero(k.own) for k in keyframes]))

    def refine(self, points: Points, which: NDArray[numpy.int64], places: Array,
               depths: Array) -> None:
        """
        Take a frame's measurements of points into their means.

        :param which: (K,), indices of points that were seen; ``places`` (K, 3), of the world.
        :param depths: (K,), at which they were seen.
        """
        for number in numpy.unique(points.keyframes[which]):
            keyframe = self.keyframes[number]
            here = points.keyframes[which] == number
            rows = points.rows[which[here]]
            old, new = keyframe.weights[rows], weight(depths[here])
            seen = moved(inverse(keyframe.pose), places[here])
            keyframe.points[rows] += (seen - keyframe.points[rows]) * (new / (old + new))[:, None]
            keyframe.weights[rows] = numpy.minimum(old + new, MOST * new)

    def similar(self, features: Features, besides: set[int], most: int) -> list[Keyframe]:
        """Return keyframes that look like an image, the most similar first."""
        candidates = [k for k in self.keyframes if k.number not in besides]
        if not candidates or not len(features):
            return []
        known = numpy.concatenate([k.features.descriptors[k.telling] for k in candidates])
        owner = numpy.repeat(range(len(candidates)), [len(k.telling) for k in candidates])
        asked = features.descriptors[::max(1, len(features) // TELLING)]
        found = cv2.BFMatcher(cv2.NORM_HAMMING).match(asked, known)
        votes = numpy.bincount([owner[f.trainIdx] for f in found
                                if f.distance <= matching.ALIKE], minlength=len(candidates))
        best = numpy.argsort(-votes, kind='stable')[:most]
        return [candidates[i] for i in best if votes[i] >= VOTES]

    def seen_from(self, keyframe: Keyframe, features: Features) -> Optional[Array]:
        """Return the pose relative to a keyframe from which its points look so, None if none."""
        deep = numpy.flatnonzero(keyframe.features.deep)
        one, two = matching.match(keyframe.features.descriptors[deep], features.descriptors)
        solution = solve(self._camera, keyframe.points[deep[one]], features.chosen(two), AGREEING)
        return None if solution is None else solution.pose

    def recognise(self, keyframe: Keyframe) -> bool:
        """Link a keyframe to a place seen long before, if this is one; return whether it is."""
        besides = {k.number for k in self.around(keyframe)} | set(
            range(keyframe.number - RECENT, keyframe.number + 1))
        for place in self.similar(keyframe.features, besides, 2):
            between = self.seen_from(place, keyframe.features)
            if between is not None:
                self._link(place, keyframe, between, self._wary)
                self.loops += 1
                self._optimise()
                return True
        return False

    def _optimise(self) -> None:
        values = gtsam.Values()
        for keyframe in self.keyframes:
            values.insert(keyframe.number, gtsam.Pose3(keyframe.pose))
        best = gtsam.LevenbergMarquardtOptimizer(self._factors, values).optimize()
        for keyframe in self.keyframes:
            keyframe.pose = best.atPose3(keyframe.number).matrix()


def weight(depths: Array) -> Array:
    """Return what measurements at depths weigh: their error grows with the square of it."""
    return numpy.asarray(depths ** -4.0)


def apart(one: Array, two: Array) -> float:
    """Return how far two poses are apart; 1 is a reason for a keyframe: 25 cm, or 12 degrees."""
    between = inverse(one) @ two
    return max(float(numpy.linalg.norm(between[:3, 3])) / 0.25, angle(between) / 0.21)
