# SPDX-License-Identifier: Apache-2.0
"""
Track the camera frame by frame, and build the map: visual SLAM.

``Slam.track`` returns as soon as the pose is known. ``Slam.extend`` then adds the frame to the
map, so that the pose need not wait for that.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Optional

import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels
from fogros2_examples.slam import features as front
from fogros2_examples.slam import matching
from fogros2_examples.slam.features import Features
from fogros2_examples.slam.geometry import Array, Camera, inverse, moved
from fogros2_examples.slam.mapping import apart, Keyframe, Map
from fogros2_examples.slam.pose import solve

#: Minimum number of points that agree on a pose.
LEAST = 20
#: Minimum number of features with a depth in a keyframe.
DEEP = 60
#: Search radius in pixels around a point's predicted position, and around its last one.
RADIUS, WIDE = 20.0, 80.0


class State(enum.Enum):
    """How well the camera's position is known."""

    STARTING = 'starting'
    TRACKING = 'tracking'
    LOST = 'lost'


@dataclasses.dataclass(frozen=True)
class Tracked:
    """
    The result of a frame.

    :param pose: (4, 4), None unless tracking.
    :param why: reason why there is no pose, '' while tracking.
    :param known: (N,), whether a feature is a point of the map.
    """

    stamp: int
    state: State
    features: Features
    pose: Optional[Array] = None
    why: str = ''
    known: NDArray[numpy.bool_] = dataclasses.field(default_factory=lambda: numpy.empty(0, bool))


class Slam:
    """
    Simultaneous localisation and mapping; the first frame's camera is the world's origin.

    :param features: maximum number of features per image.
    """

    def __init__(self, camera: Camera, features: int = 1000) -> None:
        self.camera = camera
        self.map = Map(camera)
        self.state = State.STARTING
        self._extractor = front.Extractor(camera, features)
        self._reference: Optional[Keyframe] = None
        #: Pose of the last frame relative to the reference, so that it moves with the map.
        self._last = numpy.eye(4)
        self._track: list[tuple[int, Keyframe, Array]] = []
        self._motion = numpy.eye(4)

    def track(self, stamp: int, grey: Pixels, *, depth: Optional[NDArray[numpy.generic]] = None,
              right: Optional[Pixels] = None) -> Tracked:
        """
        Compute the pose of a frame.

        :param stamp: nanoseconds.
        :param grey: (height, width), the left image of a stereo pair.
        :param depth: depth image of the same size, metres as float or millimetres as integer.
        :param right: the right image, instead of depth.
        :raises ValueError: an image has another size than the camera's.
        """
        size = (self.camera.height, self.camera.width)
        for image in (grey, depth, right):
            if image is not None and image.shape != size:
                raise ValueError(f'an image of {image.shape[1]}x{image.shape[0]} from a camera '
                                 f'of {size[1]}x{size[0]}')
        features = self._extractor.extract(grey)
        if depth is not None:
            features = front.with_depth(features, depth, self.camera)
        elif right is not None:
            features = front.with_pair(features, grey, right, self.camera)
        if self._reference is None:
            return self._start(stamp, features)
        tracked = self._follow(stamp, features) if self.state is State.TRACKING else None
        tracked = tracked or self._find(stamp, features)
        if tracked is None:
            self.state, self._motion = State.LOST, numpy.eye(4)
            return Tracked(stamp, State.LOST, features, why=(
                f'{len(features)} features in the image' if len(features) < 2 * LEAST
                else 'nothing known is in view'))
        self._track.append((stamp, self._reference, self._last))
        return tracked

    def resume(self, world: Map) -> None:
        """Continue with a map; the next frame finds its place in it."""
        if world.keyframes:
            self.map, self.state, self._reference = world, State.LOST, world.keyframes[-1]

    def trajectory(self) -> list[tuple[int, Array]]:
        """Return stamps and poses of all tracked frames, by the current map."""
        return [(stamp, keyframe.pose @ pose) for stamp, keyframe, pose in self._track]

    def extend(self, tracked: Tracked) -> bool:
        """Make a keyframe of a frame with new content; return whether the map changed."""
        reference = self._reference
        if tracked.pose is None or reference is None or tracked.features.deep.sum() < DEEP or (
                min(apart(k.pose, tracked.pose) for k in self.map.around(reference)) < 1
                and tracked.known.sum() > 0.25 * len(tracked.known)):
            return False
        keyframe = self.map.add(tracked.stamp, tracked.pose, tracked.features, tracked.known,
                                reference)
        self.map.recognise(keyframe)
        self._reference, self._last = keyframe, numpy.eye(4)
        return True

    def _start(self, stamp: int, features: Features) -> Tracked:
        deep = int(features.deep.sum())
        if deep < DEEP:
            return Tracked(stamp, State.STARTING, features, why=(
                f'{len(features)} features in the image' if len(features) < DEEP
                else f'{deep} of {len(features)} features have a depth'))
        none = numpy.zeros(len(features), bool)
        self._reference = self.map.add(stamp, numpy.eye(4), features, none)
        self.state = State.TRACKING
        self._track.append((stamp, self._reference, self._last))
        # The frame is a keyframe already, so all its features are known.
        return Tracked(stamp, State.TRACKING, features, numpy.eye(4), known=~none)

    def _follow(self, stamp: int, features: Features) -> Optional[Tracked]:
        """Search for the points near their predicted positions, then near their last ones."""
        assert self._reference is not None
        last = self._reference.pose @ self._last
        for guess, radius in ((last @ self._motion, RADIUS), (last, WIDE)):
            tracked = self._at(stamp, features, guess, radius)
            if tracked is not None and tracked.pose is not None:
                self._motion = inverse(last) @ tracked.pose
                return tracked
        return None

    def _find(self, stamp: int, features: Features) -> Optional[Tracked]:
        """Search for the camera's place among all keyframes."""
        for place in self.map.similar(features, set(), 3):
            between = self.map.seen_from(place, features)
            if between is not None:
                self._reference = place
                self._motion = numpy.eye(4)
                return self._at(stamp, features, place.pose @ between, RADIUS)
        return None

    def _at(
        self, stamp: int, features: Features, guess: Array, radius: float,
    ) -> Optional[Tracked]:
        """Compute the camera's pose from an approximate one."""
        assert self._reference is not None
        around = self.map.around(self._reference)
        points = self.map.points(around)
        seen = moved(inverse(guess), points.places)
        ahead = numpy.flatnonzero(seen[:, 2] > front.NEAREST)
        pixels = self.camera.project(seen[ahead])
        inside = ((pixels > -radius) & (
            pixels < numpy.array([self.camera.width, self.camera.height]) + radius)).all(1)
        ahead, pixels = ahead[inside], pixels[inside]
        one, two = matching.match_near(points.descriptors[ahead], pixels, features.descriptors,
                                       features.pixels, radius)
        solution = solve(self.camera, points.places[ahead[one]], features.chosen(two), LEAST,
                         guess)
        if solution is None:
            return None
        known = numpy.zeros(len(features), bool)
        known[two[solution.inliers]] = True
        right = solution.inliers & features.deep[two]
        depths = features.depths[two[right]]
        self.map.refine(points, ahead[one[right]], moved(solution.pose, self.camera.lift(
            features.pixels[two[right]], depths)), depths)
        self._reference = min(around, key=lambda k: apart(k.pose, solution.pose))
        self._last = inverse(self._reference.pose) @ solution.pose
        self.state = State.TRACKING
        return Tracked(stamp, State.TRACKING, features, solution.pose, known=known)
