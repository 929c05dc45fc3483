# SPDX-License-Identifier: Apache-2.0
"""
Render a synthetic moving scene with the statistics of photographs; frame ``n`` is reproducible.

The picture is a "dead leaves" model (Lee, Mumford and Huang, IJCV 2001): opaque shapes whose sizes
follow a power law, dropped over each other. Like photographs and unlike noise, it has occlusion
edges at all scales, a spectrum that falls with the frequency, and flat and busy areas. Each leaf
has a faint grain. A camera pans over the picture with a hand's shake, five objects cross the view
at their own speeds, the exposure drifts, and the sensor adds noise.
"""

from __future__ import annotations

import math

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels

#: The scene is larger than the view by this factor, so that the camera can pan.
FIELD = 1.6
OBJECTS = 5
#: Standard deviation of the sensor's noise, in levels of 255.
NOISE = 1.0


class Scene:
    """
    Render frames.

    :param width: width in pixels, as ``height``.
    :param rate: frames per second; the speed of motion does not depend on it.
    """

    def __init__(self, width: int, height: int, rate: float = 30.0, seed: int = 1) -> None:
        if width < 1 or height < 1 or rate <= 0:
            raise ValueError(f'no scene of {width}x{height} at {rate} Hz')
        self.width, self.height, self.rate = width, height, rate
        random = numpy.random.default_rng(seed)
        # Sizes depend only on the height, so that a wide view shows more and not larger objects.
        self._field = _leaves(random, math.ceil(width * FIELD) + 8, math.ceil(height * FIELD) + 8,
                              height)
        size = max(8, height // 4)
        self._objects = [_leaves(random, size, max(4, size * 2 // 3), size * 2)
                         for _ in range(OBJECTS)]
        self._speeds = random.uniform(0.05, 0.35, OBJECTS) * random.choice([-1, 1], OBJECTS)
        self._starts = random.uniform(0, 1, OBJECTS)
        self._rows = random.uniform(0.1, 0.8, OBJECTS)
        # One tile of noise at a random position in each frame looks as good, and is cheap.
        tile = random.normal(0, NOISE, (height + 64, width + 64, 3))
        self._noise = numpy.round(tile).astype(numpy.int8)

    def frame(self, number: int) -> Pixels:
        """Return frame ``number``: an array (height, width, 3) of BGR."""
        seconds = number / self.rate
        image = numpy.asarray(cv2.warpAffine(
            self._field, self._view(seconds), (self.width, self.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT_101), numpy.uint8)
        for index in range(OBJECTS):
            self._paste(image, index, seconds)
        random = numpy.random.default_rng(number)
        y, x = random.integers(0, 64, 2)
        noise = self._noise[y:y + self.height, x:x + self.width]
        # Exposure and noise in one saturating pass.
        gain = 1.0 + 0.03 * math.sin(seconds * 0.7)
        return numpy.asarray(cv2.addWeighted(
            image, gain, noise, 1.0, 0.0, dtype=cv2.CV_8U), numpy.uint8)

    def _view(self, seconds: float) -> NDArray[numpy.float64]:
        """Return the camera's view: a slow pan, a hand's shake, and a little roll."""
        room_x = self.width * (FIELD - 1) / 2
        room_y = self.height * (FIELD - 1) / 2
        x = room_x * (1 + 0.8 * math.sin(seconds * 0.35)) + 1.5 * math.sin(seconds * 7.1)
        y = room_y * (1 + 0.6 * math.sin(seconds * 0.23)) + 1.1 * math.sin(seconds * 8.7)
        roll = 0.02 * math.sin(seconds * 0.9)
        cosine, sine = math.cos(roll), math.sin(roll)
        return numpy.array([[cosine, -sine, x], [sine, cosine, y]])

    def _paste(self, image: Pixels, index: int, seconds: float) -> None:
        thing = self._objects[index]
        height, width = thing.shape[:2]
        way = self.width + width
        left = int((self._starts[index] + self._speeds[index] * seconds) % 1.0 * way) - width
        top = int(self._rows[index] * self.height
                  + 0.05 * self.height * math.sin(seconds * (1 + index)))
        begin_x, end_x = max(0, left), min(self.width, left + width)
        begin_y, end_y = max(0, top), min(self.height, top + height)
        if begin_x < end_x and begin_y < end_y:
            image[begin_y:end_y, begin_x:end_x] = thing[
                begin_y - top:end_y - top, begin_x - left:end_x - left]


def _leaves(random: numpy.random.Generator, width: int, height: int, scale: int) -> Pixels:
    """Drop leaves until they cover the picture; sizes are relative to ``scale``."""
    image = numpy.full((height, width, 3), 110, numpy.uint8)
    smallest, largest = max(2.0, scale / 45), scale / 2.2
    area = width * height / scale ** 2
    # Radii follow a power law of exponent -3 between two limits; large leaves come first.
    ground = largest * random.uniform(0.35, 1.0, math.ceil(60 * area))
    u = random.uniform(0, 1, math.ceil(700 * area))
    radii = numpy.concatenate(
        [ground, 1 / numpy.sqrt(u / smallest ** 2 + (1 - u) / largest ** 2)])
    greys = numpy.clip(random.normal(118, 48, len(radii)), 12, 243)
    tints = random.normal(0, 8, (len(radii), 3))
    for radius, grey, tint in zip(radii, greys, tints):
        centre = (int(random.uniform(0, width)), int(random.uniform(0, height)))
        axes = (max(1, int(radius)), max(1, int(radius * random.uniform(0.4, 1.0))))
        colour = tuple(float(c) for c in numpy.clip(grey + tint, 0, 255))
        if random.uniform() < 0.5:
            cv2.ellipse(image, centre, axes, float(random.uniform(0, 180)), 0, 360, colour, -1,
                        cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((centre, (2.0 * axes[0], 2.0 * axes[1]),
                                     float(random.uniform(0, 180))))
            cv2.fillConvexPoly(image, corners.astype(numpy.int32), colour, cv2.LINE_AA)
    # A lens is never sharper than its sensor.
    soft = cv2.GaussianBlur(image, (0, 0), 0.9)
    grain = cv2.GaussianBlur(random.normal(0, 1, (height, width)), (0, 0), 1.2)
    grain *= 2.0 / grain.std()
    grained = soft.astype(numpy.float32) + grain[:, :, None].astype(numpy.float32)
    return numpy.clip(grained, 0, 255).astype(numpy.uint8)
