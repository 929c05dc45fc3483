# SPDX-License-Identifier: Apache-2.0
"""
Predict organised scans of a lidar as range images: of each point, only the distance is sent.

The azimuth of a point is that of its column plus that of its row, and its slope is that of its
row. These directions are fitted to each scan and sent with it, so that each scan can be decoded
alone. The fit is the best approximation of the points (x + iy) by a number of the column times a
number of the row, found by alternating least squares.
"""

from __future__ import annotations

from typing import Any

import numpy
from numpy.typing import NDArray

Reals = NDArray[numpy.float64]
#: Azimuths of columns and of rows in units of ANGLE, slopes of rows.
Directions = tuple[NDArray[numpy.int32], NDArray[numpy.int32], NDArray[numpy.float32]]
#: Unit of the azimuths: 0.03 mm at 60 m.
ANGLE = 1e-6
#: Alternations of the fit; after three, the error of a city's scan is that of float32.
ITERATIONS = 4


def fit(x: Reals, y: Reals, z: Reals, far: Reals) -> Directions:
    """
    Return the directions of a scan of (rows, columns) points.

    :param x: zero where there is no point; likewise ``y`` and ``z``.
    :param far: horizontal distances.
    """
    # Weighted by the distance, because far points know their direction best. A matrix product
    # would be threads of BLAS, which wait for each other on a busy computer.
    flat = (x + 1j * y).astype(numpy.complex64)
    rows = numpy.ones(x.shape[0], numpy.complex64)
    for _ in range(ITERATIONS):
        columns = _unit((flat * rows.conj()[:, None]).sum(0))
        rows = _unit((flat * columns.conj()).sum(1))
    slopes = (z * far).sum(1) / numpy.maximum((far * far).sum(1), 1e-30)
    return _angles(columns), _angles(rows), slopes.astype('<f4')


def predict(directions: Directions, far: Reals) -> tuple[Reals, Reals, Reals]:
    """Return x, y and z of a scan by its horizontal distances."""
    columns, rows, slopes = directions
    turned = numpy.exp(1j * ANGLE * columns) * numpy.exp(1j * ANGLE * rows)[:, None]
    return far * turned.real, far * turned.imag, far * slopes[:, None]


def _unit(values: Any) -> Any:
    return values / numpy.maximum(numpy.abs(values), numpy.float32(1e-30))


def _angles(units: Any) -> Any:
    return numpy.rint(numpy.angle(units) / ANGLE).astype('<i4')
