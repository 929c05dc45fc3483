# SPDX-License-Identifier: Apache-2.0
"""Draw the courses of an arm's tip, and the age of each action."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy

from fogros2_examples.policy.arm import RADIUS

COLOURS = ('#d1495b', '#2e6f95', '#66a182', '#edae49')


def summary(run: Mapping[str, Any]) -> str:
    """Return a line about a run of ``policy_arm``."""
    done, age = list(run['reached'].values()), 1e3 * numpy.median(numpy.array(run['ages'])[:, 1])
    return (f"{run['label']}: {len(done)} of {len(run['targets'])} targets reached, after "
            f'{numpy.mean(done or [numpy.nan]):.2f} s; median age of an action {age:.0f} ms')


def draw(path: Path, runs: Sequence[Mapping[str, Any]]) -> None:
    """
    Draw runs from above, with the tip's distance from the target and the age of each action.

    :param path: file of the picture; its extension is the format.
    :param runs: of ``policy_arm``, with the same targets.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    figure = Figure(figsize=(12, 6), dpi=130, layout='constrained')
    grid = figure.add_gridspec(2, 2, width_ratios=[1.1, 1])
    plan, far, age = map(figure.add_subplot, (grid[:, 0], grid[0, 1], grid[1, 1]))
    for number, target in enumerate(runs[-1]['targets']):
        plan.add_patch(Circle(target, RADIUS, facecolor='#f2d0d0'))
        plan.text(target[0], target[1], str(number + 1), ha='center', va='center')
        for axes in (far, age):
            axes.axvline(number * runs[-1]['shown'], color='#b8c0cc', lw=1)
    for run, colour in zip(runs[-len(COLOURS):], COLOURS):
        times, x, y, distance = numpy.array(run['course']).T
        plan.plot(x, y, color=colour, lw=1.6, alpha=0.8, label=summary(run))
        far.plot(times, 100 * distance, color=colour, lw=1.3)
        when, ages = numpy.array(run['ages']).T
        age.plot(when, 1e3 * ages, '.', color=colour, ms=3)
    plan.plot(0, 0, 's', color='#222222', ms=7)
    plan.set(aspect='equal', title='Course of the tip, from target to target, in m')
    far.set(title='Distance from the target (cm)')
    age.set(title='Age of each action (ms)', yscale='log', xlabel='time (s)')
    figure.legend(loc='outside lower center', ncols=2, fontsize=9)
    for axes in (plan, far, age):
        axes.grid(color='#e5e8ec', lw=0.6)
    figure.savefig(path)
