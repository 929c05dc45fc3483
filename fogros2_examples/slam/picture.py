# SPDX-License-Identifier: Apache-2.0
"""Draw the trajectory against ground truth, as in papers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy

from fogros2_examples.slam.evaluation import Accuracy
from fogros2_examples.slam.room import FURNITURE, SIZE

TRUTH, ESTIMATE, FAINT = '#222222', '#d1495b', '#8d99ae'


def draw(path: Path, result: Accuracy, trips: Sequence[float], furnished: bool) -> None:
    """
    Draw a trajectory from above, its error, and the round trips.

    :param path: file of the picture; its extension is the format.
    :param trips: round trip of each frame in milliseconds.
    :param furnished: whether to draw the synthetic room too.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(11, 5.6), dpi=130, layout='constrained')
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.45, 1])
    plan = figure.add_subplot(grid[:, 0])
    # The two axes with the largest motion: a view from above, whatever axis is up in a dataset.
    spread = numpy.argsort(-numpy.ptp(result.truth, axis=0))
    a, b = (0, 1) if furnished else sorted(int(axis) for axis in spread[:2])
    if furnished:
        plan.add_patch(Rectangle((0, 0), SIZE[0], SIZE[1], fill=False, edgecolor=TRUTH, lw=2))
        for low, high, _ in FURNITURE:
            plan.add_patch(Rectangle(low[:2], high[0] - low[0], high[1] - low[1],
                                     facecolor='#edf0f4', edgecolor=FAINT, lw=0.8))
    truth, estimate = result.truth[:, [a, b]], result.aligned[:, [a, b]]
    plan.plot(*truth.T, color=FAINT, lw=5, solid_capstyle='round', label='ground truth')
    coloured = plan.add_collection(LineCollection(
        numpy.stack([estimate[:-1], estimate[1:]], 1).tolist(), array=100 * result.errors[1:],
        cmap='plasma', linewidths=2))
    coloured.set_clim(0, 100 * float(result.errors.max()))
    figure.colorbar(coloured, ax=plan, shrink=0.7, label='SLAM: distance from it (cm)')
    plan.plot(*truth[0], 'o', color=TRUTH, ms=7, label='start')
    plan.plot(*truth[-1], 's', color=TRUTH, ms=6, label='end')
    plan.set_aspect('equal')
    plan.set_xlabel(f'{"xyz"[a]} (m)')
    plan.set_ylabel(f'{"xyz"[b]} (m)')
    plan.legend(loc='upper left' if furnished else 'best', frameon=True, fontsize=9)
    plan.set_title('Trajectory against ground truth', fontsize=12)

    error, trip = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
    centimetres = 100 * result.errors
    error.fill_between(range(len(centimetres)), centimetres, color=ESTIMATE, alpha=0.25, lw=0)
    error.plot(centimetres, color=ESTIMATE, lw=1.2)
    error.axhline(100 * result.ate, color=TRUTH, lw=1, ls=':')
    error.set_title(f'Error: ATE {100 * result.ate:.2f} cm, RPE {100 * result.rpe:.2f} cm/m',
                    fontsize=11)
    error.set_xlabel('frame')
    error.set_ylabel('distance (cm)')
    error.set_ylim(bottom=0)
    trip.plot(trips, '.', color='#2e6f95', ms=4)
    middle = float(numpy.median(trips))
    trip.axhline(middle, color=TRUTH, lw=1, ls=':')
    trip.set_title(f'Round trip of a frame: median {middle:.0f} ms', fontsize=11)
    trip.set_xlabel('frame')
    trip.set_ylabel('ms')
    trip.set_ylim(0, 1.15 * float(numpy.quantile(trips, 0.98)))
    for axes in (plan, error, trip):
        axes.grid(color='#e5e8ec', lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[['top', 'right']].set_visible(False)
    figure.savefig(path)
