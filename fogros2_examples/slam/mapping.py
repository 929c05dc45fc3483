# SPDX-License-Identifier: Apache-2.0
"""
Store the map: keyframes with their points, and the pose graph that connects the keyframes.

A point belongs to the keyframe that saw it first, in that camera's frame. If the graph moves
keyframes, their points move too. GTSAM optimises the graph.
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

#: Standard deviation of the pose of one keyframe relative to another: radians, metres.
TURN, SHIFT = 0.004, 0.008
#: Descriptors to recognise a keyframe by, and how many of them must match.
TELLING, VOTES = 250, 20
#: Minimum number of common points to recognise a place.
AGREEING = 40
#: Number of preceding keyframes that are too recent to be a revisited place.
RECENT = 8
#: Maximum weight of a point, in measurements, so that it can still move.
MOST = 20
#: Number of keyframes whose points are tracked at once.
LOCAL = 12


@dataclasses.dataclass
class Keyframe:
    """
    A frame that is part of the map.
    :param points: (N, 3), points of its features in its camera's frame; nan without a depth.
    :param own: (N,), whether a point belongs to this keyframe and to no earlier one.
    :param weights: (N,), weights of the measurements in the mean of each point.
    :param telling: indices of the features to recognise the keyframe by.
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

    :param places: (M, 3), positions in the world.
    :param descriptors: (M, 32).
    :param keyframes: (M,), numbers of the keyframes; ``rows`` (M,), indices of their features.
    """

    places: Array
    descriptors: NDArray[numpy.uint8]
    keyframes: NDArray[numpy.int64]
    rows: NDArray[numpy.int64]


class Map:
    """Keyframes in the order of their creation, and the pose graph."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.keyframes: list[Keyframe] = []
        #: Number of revisited places so far.
        self.loops = 0
        #: Numbers of two keyframes, the pose of the second relative to the first, and whether
        #: the link may be wrong.
        self.links: list[tuple[int, int, Array, bool]] = []
        self._noise = gtsam.noiseModel.Diagonal.Sigmas(numpy.array([TURN] * 3 + [SHIFT] * 3))
        # A robust model, so that one wrong recognition does not bend the whole map.
        self._wary = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Cauchy.Create(3.0), self._noise)

    def add(self, stamp: int, pose: Array, features: Features, known: NDArray[numpy.bool_],
            reference: Optional[Keyframe] = None) -> Keyframe:
        """
        Create a keyframe, linked to the reference.

        :param known: (N,), whether a feature is a point of another keyframe.
        """
        points = self._camera.lift(features.pixels, features.depths)
        deep = numpy.flatnonzero(features.deep)
        keyframe = Keyframe(
            len(self.keyframes), stamp, pose, features, points, features.deep & ~known,
            weight(features.depths), deep[::max(1, len(deep) // TELLING)][:TELLING])
        self.keyframes.append(keyframe)
        if reference is not None:
            self.link(reference, keyframe, inverse(reference.pose) @ pose)
        return keyframe

    def link(self, one: Keyframe, two: Keyframe, between: Array, wary: bool = False) -> None:
        """Link two keyframes; ``wary`` if the link may be wrong."""
        self.links.append((one.number, two.number, between, wary))
        one.links.add(two.number)
        two.links.add(one.number)

    def around(self, keyframe: Keyframe) -> list[Keyframe]:
        """Return a keyframe and its neighbours in the graph, nearest first, at most ``LOCAL``."""
        nearby, edge = {keyframe.number: None}, [keyframe.number]
        while edge and len(nearby) < LOCAL:
            edge = [other for number in edge for other in sorted(
                self.keyframes[number].links, reverse=True) if other not in nearby]
            nearby.update(dict.fromkeys(edge))
        return [self.keyframes[number] for number in list(nearby)[:LOCAL]]

    @staticmethod
    def points(keyframes: list[Keyframe]) -> Points:
        """Return the points that belong to keyframes."""
        return Points(
            numpy.concatenate([moved(k.pose, k.points[k.own]) for k in keyframes]),
            numpy.concatenate([k.features.descriptors[k.own] for k in keyframes]),
            numpy.concatenate([numpy.full(k.own.sum(), k.number) for k in keyframes]),
            numpy.concatenate([numpy.flatnonzero(k.own) for k in keyframes]))

    def refine(self, points: Points, which: NDArray[numpy.int64], places: Array,
               depths: Array) -> None:
        """
        Update the means of points by a frame's measurements.

        :param which: (K,), indices of the measured points; ``places`` (K, 3), in the world.
        :param depths: (K,), depths of the measurements.
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
        sample = features.descriptors[::max(1, len(features) // TELLING)]
        matches = cv2.BFMatcher(cv2.NORM_HAMMING).match(sample, known)
        votes = numpy.bincount([owner[f.trainIdx] for f in matches
                                if f.distance <= matching.ALIKE], minlength=len(candidates))
        best = numpy.argsort(-votes, kind='stable')[:most]
        return [candidates[i] for i in best if votes[i] >= VOTES]

    def seen_from(self, keyframe: Keyframe, features: Features) -> Optional[Array]:
        """Return a frame's pose relative to a keyframe, None if too few points match."""
        deep = numpy.flatnonzero(keyframe.features.deep)
        one, two = matching.match(keyframe.features.descriptors[deep], features.descriptors)
        solution = solve(self._camera, keyframe.points[deep[one]], features.chosen(two), AGREEING)
        return None if solution is None else solution.pose

    def recognise(self, keyframe: Keyframe) -> bool:
        """Link a keyframe to a place that was seen long before; return False if there is none."""
        besides = {k.number for k in self.around(keyframe)} | set(
            range(keyframe.number - RECENT, keyframe.number + 1))
        for place in self.similar(keyframe.features, besides, 2):
            between = self.seen_from(place, keyframe.features)
            if between is not None:
                self.link(place, keyframe, between, True)
                self.loops += 1
                self._optimise()
                return True
        return False

    def _optimise(self) -> None:
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.add(gtsam.PriorFactorPose3(
            0, gtsam.Pose3(self.keyframes[0].pose), self._noise))
        for one, two, between, wary in self.links:
            factors.add(gtsam.BetweenFactorPose3(
                one, two, gtsam.Pose3(between), self._wary if wary else self._noise))
        for keyframe in self.keyframes:
            values.insert(keyframe.number, gtsam.Pose3(keyframe.pose))
        best = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
        for keyframe in self.keyframes:
            keyframe.pose = best.atPose3(keyframe.number).matrix()


def weight(depths: Array) -> Array:
    """Return the weights of measurements; the error grows with the square of the depth."""
    return numpy.asarray(depths ** -4.0)


def apart(one: Array, two: Array) -> float:
    """Return the distance of two poses; a new keyframe is due from 1 on: 25 cm, or 12 degrees."""
    between = inverse(one) @ two
    return max(float(numpy.linalg.norm(between[:3, 3])) / 0.25, angle(between) / 0.21)
