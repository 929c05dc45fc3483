# SPDX-License-Identifier: Apache-2.0
"""Scan a synthetic city by a spinning lidar on a robot that drives along a street."""

from __future__ import annotations

from typing import Any

import numpy
from numpy.typing import NDArray

#: One point: as drivers of spinning lidars publish it, without padding.
POINT = numpy.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('intensity', '<f4'),
                     ('ring', '<u2'), ('time', '<f4')])
#: Seconds of a turn, metres that the robot drives meanwhile, height and range of the lidar.
TURN, STRIDE, HEIGHT, RANGE = 0.1, 0.4, 1.8, 120.0
#: Standard deviations of a distance (m), of the encoder's angle (degrees) and of the intensity,
#: and the share of pulses without an echo.
NOISE, JITTER, SHIMMER, LOST = 0.015, 0.005, 3.0, 0.02


class City:
    """
    Houses along streets, cars and poles, the same ones each time.

    :param rows: lasers, from 15 degrees above the horizon to 25 below.
    :param columns: firings of a turn.
    """

    def __init__(self, rows: int = 64, columns: int = 1024) -> None:
        self.rows, self.columns = rows, columns
        rng = numpy.random.default_rng(1)
        houses = [(40 * x + rng.uniform(8, 12), 40 * y + rng.uniform(8, 12),
                   rng.uniform(18, 26), rng.uniform(18, 26), rng.uniform(6, 30),
                   rng.uniform(30, 200)) for x in range(-4, 4) for y in range(-4, 4)]
        things = [(*rng.uniform(-100, 100, 2), rng.uniform(0.3, 4.5), rng.uniform(0.3, 2),
                   rng.uniform(1.2, 4), rng.uniform(10, 250)) for _ in range(150)]
        #: x, y, length, width, height, brightness
        self._boxes = numpy.array([*houses, *things])
        self._slopes = numpy.radians(numpy.linspace(15, -25, rows) + rng.normal(0, 0.05, rows))
        # the lasers of a column do not stand in line
        self._turned = numpy.radians(numpy.resize([-3.1, -1.0, 1.0, 3.1], rows))

    def scan(self, number: int) -> NDArray[Any]:
        """Return scan ``number`` of a drive: an array (rows, columns) of POINT, NaN for none."""
        rng = numpy.random.default_rng(number)
        azimuth = numpy.linspace(numpy.pi, -numpy.pi, self.columns, endpoint=False)
        azimuth += rng.normal(0, numpy.radians(JITTER), self.columns)
        turned = azimuth + self._turned[:, None]
        flat = numpy.cos(self._slopes)[:, None]
        rays = numpy.stack([numpy.cos(turned) * flat, numpy.sin(turned) * flat,
                            numpy.broadcast_to(numpy.sin(self._slopes)[:, None], turned.shape)])
        start = numpy.array([1.0 + STRIDE * number, 2.0, HEIGHT])
        distance, brightness = self._hits(start, rays)
        distance += rng.normal(0, NOISE, distance.shape)
        hit = (distance < RANGE) & (rng.random(distance.shape) > LOST)
        cloud = numpy.zeros(distance.shape, POINT)
        for name, ray in zip('xyz', rays):
            cloud[name] = numpy.where(hit, distance * ray, numpy.nan)
        shimmer = numpy.rint(brightness + rng.normal(0, SHIMMER, brightness.shape))
        cloud['intensity'] = numpy.where(hit, numpy.clip(shimmer, 0, 255), 0)
        cloud['ring'] = numpy.arange(self.rows)[:, None]
        cloud['time'] = numpy.arange(self.columns) * (TURN / self.columns)
        return cloud

    def _hits(self, start: NDArray[Any], rays: NDArray[Any]) -> tuple[Any, Any]:
        """Return distance and brightness of the nearest surface along each ray."""
        with numpy.errstate(divide='ignore', invalid='ignore'):
            distance = numpy.where(rays[2] < 0, -start[2] / rays[2], numpy.inf)
            tiles = sum(numpy.floor((start[axis] + distance * rays[axis]) / 3) % 2
                        for axis in (0, 1))
            brightness = numpy.where(numpy.isfinite(distance), 20 + 10 * tiles, 0)
            for x, y, length, width, height, bright in self._boxes:
                if numpy.hypot(x - start[0], y - start[1]) > RANGE + 40:
                    continue
                low, high = numpy.array([x, y, 0]), numpy.array([x + length, y + width, height])
                one = (low - start)[:, None, None] / rays
                other = (high - start)[:, None, None] / rays
                near = numpy.minimum(one, other).max(0)
                hit = (near < numpy.maximum(one, other).min(0)) & (near > 0.5) & (near < distance)
                distance[hit], brightness[hit] = near[hit], bright
        return distance, brightness
