# SPDX-License-Identifier: Apache-2.0
"""
Draw the figures of a benchmark; each picture reads the same way.

A row is a point on a logarithmic axis, on which further left is better. First come values of one
unit beside each other, as ``PANELS`` lists them, then the ratio of each other value to its target.
The value, its target and its number of runs are text beside the point.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
import hashlib
import math
from pathlib import Path
import re
import textwrap
from typing import Any, Optional, TYPE_CHECKING

if TYPE_CHECKING:
    from figures import Row


@dataclasses.dataclass(frozen=True)
class Panel:
    """
    Values of one unit beside each other, of which less is better.

    :param rows: a regular expression that is searched for in the names of the rows; the heading
        says what a match with ': ' or ', ' at its begin says, so labels leave it out.
    :param unit: of the rows, '' for ratios to a limit, which is 1.
    """

    heading: str
    rows: str
    unit: str


_LIMIT = Panel('Ratio to the limit of link and codec', ': median over limit$', '')
_STARTS = (Panel('From ros2 launch to the first message', ': to the first message$', 's'),
           Panel('Several machines of one launch', r'instances?, boot delay \d+ s$', 's'))
_STREAMS = (Panel('From an image to its answer, median', ': median$', 'ms'), _LIMIT)

#: Benchmarks that have a picture. The table alone shows the others: their values are counts with
#: a target of 0, or too few to compare.
PANELS: Mapping[str, Sequence[Panel]] = {
    'applications': (
        Panel('Time of the network, ratio to the limit of the link', ': network over its limit$',
              ''),
        Panel('Error of the trajectory (ATE), ratio to raw images', '^visual.* ATE over', '')),
    'command_line': (
        Panel('Until the command ends', '^(ros2 (-h|fog list)|import .*|from .*)$', 's'),),
    'discovery': (
        Panel('Until all know all: time', ': until all know all$', 's'),
        Panel('Until all know all: traffic', ': until all know all$', 'kB'),
        Panel('From then on: traffic', ': from then on$', 'kB/s')),
    'fleet': (
        Panel('Another robot joins', 'join|same node', 's'),
        Panel('A shared message from node to node', 'shared message|relay', 'ms')),
    'launch_time': (Panel('From ros2 launch to the first message', 'both|^talker', 's'),),
    'machines': (Panel('Until all machines are ready', r'^\d+ machine', 's'),),
    'monitor': (
        Panel('From publisher to viewer', ', publish to viewer, median$', 'ms'),
        Panel('Processor time, of one core', '.', '% CPU')),
    'nodes': (),
    'point_clouds': (_LIMIT,),
    'policy': (
        Panel('From an observation to the action, three cameras', ': median$', 'ms'),
        _LIMIT),
    'resilience': (
        Panel('One replica killed, one slowed, time of 99 of 100', '^the same: P99', 'ms'),
        Panel('Recorded planning times, 99 of 100', '^(plans|recorded) .*P99', 'ms'),
        Panel('A call', '^call', 'ms')),
    'round_trip': (Panel('A message there and back', '^(between|to) ', 'ms'),),
    'shared_link': (Panel('There and back, time of 95 of 100', ': p95$', 'ms'),),
    'startup_aws': _STARTS,
    'startup_azure': _STARTS,
    'startup_gcp': _STARTS,
    'startup_kubernetes': (
        _STARTS[0],
        Panel('Pods of one launch', r'^\d+ .*until', 's')),
    'streaming': _STREAMS,
    'streaming-video': _STREAMS,
    'sync': (Panel('Until the workspace is on the machine', '.', 's'),),
}

_REACHED, _MISSED, _PLAIN, _INK = '#1f7a5c', '#b3412e', '#5d6b78', '#222222'
_WIDTH, _LINE = 10.0, 0.27
#: Where the plots and the columns of text begin and end, as shares of the width.
_LEFT, _RIGHT, _VALUE, _TARGET, _RUNS = 0.36, 0.7, 0.83, 0.92, 0.985


def number(value: float) -> str:
    """Return four digits of a number as people write it, without an exponent."""
    if value == 0 or not math.isfinite(value):
        return f'{value:g}'
    places = max(0, 3 - math.floor(math.log10(abs(value))))
    text = f'{value:.{places}f}' if abs(value) < 10_000 else f'{value:,.0f}'
    return text.rstrip('0').rstrip('.') if '.' in text else text


def mark(name: str, rows: Sequence[Row]) -> str:
    """Return what a picture's file says of the figures that it shows."""
    return hashlib.sha256(repr((PANELS[name], [
        (row.what, row.value, row.unit, row.target, row.better, row.runs, row.low, row.high)
        for row in rows])).encode()).hexdigest()


@dataclasses.dataclass(frozen=True)
class Point:
    """A row where it is drawn; ``target`` is on the same axis."""

    row: Row
    label: str
    at: float
    low: float
    high: float
    target: Optional[float]


def panels(name: str, rows: Sequence[Row]) -> Iterator[tuple[Panel, list[Point]]]:
    """Yield each panel of a picture with its points; ratios to a target have the unit 'target'."""
    rest = list(rows)
    for panel in PANELS[name]:
        chosen = [(row, match) for row in rest if row.unit == panel.unit and row.better == 'less'
                  and (match := re.search(panel.rows, row.what))]
        rest = [row for row in rest if all(row is not other for other, _ in chosen)]
        if chosen:
            yield panel, [
                Point(row, row.what[:match.start()] if match[0][:2] in (': ', ', ') else row.what,
                      row.value, _or(row.low, row.value), _or(row.high, row.value), row.target)
                for row, match in chosen]
    # a complete count, such as 10 of 10, says nothing on an axis
    judged = [row for row in rest if row.target
              and not (row.better == 'more' and row.value == row.target)]
    if judged:
        yield Panel('Ratio to the target', '', 'target'), [
            Point(row, row.what, *_ratios(row), 1.0) for row in judged]


def _or(value: Optional[float], other: float) -> float:
    return other if value is None else value


def _ratios(row: Row) -> tuple[float, float, float]:
    """Return the ratio of a value to its target, and of its spread; less is better."""
    assert row.target
    ratios = [value / row.target if row.better == 'less' else
              row.target / value if value else math.inf
              for value in (row.value, _or(row.low, row.value), _or(row.high, row.value))]
    return ratios[0], min(ratios[1:]), max(ratios[1:])


def draw(path: Path, title: str, note: str, rows: Sequence[Row]) -> None:
    """Write the picture of a benchmark, whose name is the file's."""
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    drawn = [(panel, points, [textwrap.wrap(point.label, 50, break_on_hyphens=False)
                              for point in points])
             for panel, points in panels(path.stem, rows)]
    footer = [*textwrap.wrap(note, 130), *_explanation([panel for panel, *_ in drawn])]
    heights = [sum(max(1.3, 0.75 * len(lines) + 0.3) for lines in labels) for *_, labels in drawn]
    above, below, between = 0.5, 0.5 + 0.15 * len(footer), 0.8
    height = above + below + sum(_LINE * h + between for h in heights)
    figure = pyplot.figure(figsize=(_WIDTH, height))
    figure.text(0.015, 1 - 0.18 / height, title, fontsize=14, weight='bold', va='top', color=_INK)
    top = height - above
    for (panel, points, labels), lines in zip(drawn, heights):
        size = _LINE * lines
        axes = figure.add_axes((
            _LEFT, (top - 0.45 - size) / height, _RIGHT - _LEFT, size / height))
        _panel(figure, axes, panel, points, labels, height)
        top -= size + between
    figure.legend(handles=_legend(drawn), loc='lower left', ncols=6, frameon=False, fontsize=9,
                  bbox_to_anchor=(0.005, (below - 0.45) / height), handletextpad=0.5,
                  columnspacing=1.2)
    figure.text(0.015, 0.1 / height, '\n'.join(footer), fontsize=8, color=_PLAIN, va='bottom')
    figure.savefig(path, dpi=110, metadata={'Description': mark(path.stem, rows)})
    pyplot.close(figure)


def _explanation(shown: Sequence[Panel]) -> Iterator[str]:
    if any(panel.unit == 'target' for panel in shown):
        yield ('The ratio to the target is value / target, or target / value where more is '
               'better: left of the line, the target is reached.')


def _style(point: Point) -> dict[str, Any]:
    if point.row.reached is None:
        return {'marker': 'o', 'color': _PLAIN, 'markerfacecolor': 'white'}
    return ({'marker': 'o', 'color': _REACHED} if point.row.reached else
            {'marker': 'D', 'color': _MISSED})


def _panel(
    figure: Any, axes: Any, panel: Panel, points: Sequence[Point], labels: Sequence[list[str]],
    height: float,
) -> None:
    low, high = span([*points], panel.unit in ('', 'target'))
    axes.set_xscale('log')
    axes.set_xlim(low, high)
    marks = list(ticks(low, high))
    axes.set_xticks(marks, [number(tick) for tick in marks], fontsize=9)
    axes.set_xticks([], minor=True)
    axes.grid(axis='x', color='#e4e7ea', linewidth=0.8)
    axes.set_axisbelow(True)
    at, places = 0.0, []
    for lines in labels:
        size = max(1.3, 0.75 * len(lines) + 0.3)
        places.append(at + size / 2)
        at += size
    axes.set_ylim(at, 0)
    axes.set_yticks(places, ['\n'.join(lines) for lines in labels], fontsize=9, color=_INK)
    axes.tick_params(length=0)
    axes.spines[['top', 'right', 'left']].set_visible(False)
    axes.spines['bottom'].set_color('#aab2b9')
    if panel.unit in ('', 'target'):
        axes.axvline(1.0, color=_INK, linewidth=1.2,
                     linestyle='-' if panel.unit == 'target' else (0, (2, 2)), zorder=1)
    for point, y in zip(points, places):
        style = _style(point)
        if panel.unit != 'target' and point.target:
            axes.plot([point.target] * 2, [y - 0.5, y + 0.5], color=_INK, linewidth=2, zorder=2)
        if point.low < point.high:
            axes.plot([max(point.low, low), min(point.high, high)], [y, y], color=style['color'],
                      linewidth=2, alpha=0.55, zorder=3)
        style |= {'marker': _beyond(point, low, high) or style['marker']}
        margin = (high / low)**0.02
        axes.plot([min(max(point.at, low * margin), high / margin)], [y], linestyle='',
                  markersize=7, zorder=4, **style)
        _columns(figure, axes, point.row, y)
    box = axes.get_position()
    above = box.y1 + 0.1 / height
    unit = '' if panel.unit in ('', 'target') else f', {panel.unit}'
    figure.text(0.015, above, panel.heading + unit, fontsize=10.5, weight='bold', color=_INK)
    figure.text(_LEFT + 0.19, above, '\N{LEFTWARDS ARROW} better', fontsize=10, color=_REACHED,
                ha='left')
    for x, word in ((_VALUE, 'value'), (_TARGET, 'target'), (_RUNS, 'runs')):
        figure.text(x, above, word, fontsize=9, color=_PLAIN, ha='right')


def _beyond(point: Point, low: float, high: float) -> str:
    """Return the marker of a value that a logarithmic axis cannot show, '' for others."""
    return '<' if point.at < low else '>' if point.at > high else ''


def _columns(figure: Any, axes: Any, row: Row, y: float) -> None:
    from matplotlib.transforms import blended_transform_factory

    beside = blended_transform_factory(figure.transFigure, axes.transData)
    sign = '\N{LESS-THAN OR EQUAL TO}' if row.better == 'less' else \
        '\N{GREATER-THAN OR EQUAL TO}'
    target = '' if row.target is None else f'{sign} {number(row.target)}'
    for x, text in ((_VALUE, f'{number(row.value)} {row.unit}'.strip()), (_TARGET, target),
                    (_RUNS, number(row.runs))):
        axes.text(x, y, text, transform=beside, ha='right', va='center', fontsize=9,
                  color=_MISSED if row.reached is False and x == _VALUE else _INK)


def span(points: Sequence[Point], ratio: bool) -> tuple[float, float]:
    """Return the ends of an axis that shows all points, three times as large at least."""
    shown = [value for point in points
             for value in (point.at, point.low, point.high, point.target or 0.0)
             if 0 < value < math.inf] + [1.0] * ratio or [1.0]
    low, high = min(shown), max(shown)
    wider = max(1.1 * (high / low)**0.04, math.sqrt(3 * low / high))
    return low / wider, high * wider


def ticks(low: float, high: float) -> Iterator[float]:
    """Yield round numbers between two: about three to eight."""
    decades = math.log10(high / low)
    steps = (1, 1.2, 1.5, 2, 3, 5, 7) if decades < 0.8 else (1, 2, 5) if decades < 2.3 else (1,)
    for exponent in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1):
        yield from (tick for step in steps if low <= (tick := step * 10.0**exponent) <= high)


def _legend(drawn: Sequence[tuple[Panel, Sequence[Point], object]]) -> list[Any]:
    """Return an entry for each kind of sign in the picture."""
    from matplotlib.lines import Line2D

    points = [point for _, shown, _ in drawn for point in shown]
    entries = []
    for reached, word in ((True, 'target reached'), (False, 'target missed'), (None, 'no target')):
        for point in [point for point in points if point.row.reached is reached][:1]:
            entries.append(Line2D([], [], linestyle='', markersize=7, label=word, **_style(point)))
    if any(point.target for point in points):
        entries.append(Line2D([], [], linestyle='', marker='|', markersize=11, color=_INK,
                              markeredgewidth=2, label='target'))
    ratios = [panel.heading for panel, *_ in drawn if panel.unit == '']
    if ratios:
        entries.append(Line2D([], [], color=_INK, linestyle=(0, (2, 2)), linewidth=1.2, label=(
            'limit, or raw images' if any('raw' in heading for heading in ratios) else 'limit')))
    if any(point.at in (0.0, math.inf) for point in points):
        entries.append(Line2D([], [], linestyle='', marker='<', markersize=7, color=_REACHED,
                              label='0, beyond the axis'))
    if any(point.low < point.high for point in points):
        entries.append(Line2D([], [], color=_PLAIN, alpha=0.55, linewidth=2,
                              label='5th to 95th percentile'))
    return entries
