# SPDX-License-Identifier: Apache-2.0
"""The figures of benchmarks: how they are written as text, judged, and drawn."""

from __future__ import annotations

from collections.abc import Iterator
import importlib
import math
from pathlib import Path
import sys
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[2] / 'benchmarks'
STORED = sorted(path.stem for path in (BENCHMARKS / 'results').glob('*.json')
                if '"machine"' in path.read_text())


@pytest.fixture(scope='module')
def figures() -> Iterator[Any]:
    """Import the module, which only benchmarks have on their path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module('figures')
        for name in ('figures', 'figures.plots'):
            sys.modules.pop(name)


@pytest.mark.parametrize('value, text', [
    (0, '0'), (0.006611, '0.006611'), (0.12727, '0.1273'), (30.0000045, '30'), (955.8979, '955.9'),
    (2108.1, '2108'), (41868.2, '41,868'), (100_000, '100,000'), (9999.9, '10000'),
    (-0.25, '-0.25'), (math.inf, 'inf')])
def test_numbers_have_four_digits_and_no_exponent(figures: Any, value: float, text: str) -> None:
    assert figures.number(value) == text


def test_row_of_runs_has_median_spread_and_count(figures: Any) -> None:
    few = figures.Row.of('start', [3.0, 1.0, 2.0], 's', 4.0)
    assert (few.value, few.low, few.high, few.runs, few.target) == (2.0, 1.0, 3.0, 3, 4.0)
    many = figures.Row.of('start', range(100), 's')
    assert (many.value, many.low, many.high, many.runs) == (49.5, 5, 94, 100)
    assert '| start | 2 s (1 to 3) | ≤ 4 s | yes | 3 |' in figures.markdown('', [few], '')


def test_ratio_to_target_is_smaller_where_better(figures: Any) -> None:
    rows = [figures.Row('late', 6.0, 's', 4.0, low=5.0, high=8.0),
            figures.Row('rate', 40.0, '1/s', 20.0, 'more', low=10.0, high=80.0),
            figures.Row('none', 0.0, '1/s', 20.0, 'more'), figures.Row('never', 0.0, 's', 1.0),
            # says nothing on an axis: no target, a target of zero, a complete count
            figures.Row('other', 1.0, 's'), figures.Row('left', 0.0, 'things', 0.0),
            figures.Row('all', 10.0, 'nodes', 10.0, 'more')]
    (panel, points), = figures.plots.panels('nodes', rows)
    assert panel.unit == 'target'
    assert [(point.label, point.at, point.low, point.high) for point in points] == [
        ('late', 1.5, 1.25, 2.0), ('rate', 0.5, 0.25, 2.0),
        ('none', math.inf, math.inf, math.inf), ('never', 0.0, 0.0, 0.0)]


def test_values_of_a_panel_are_no_ratios(figures: Any) -> None:
    rows = [figures.Row('raw: median', 900.0, 'ms', high=1200.0),
            figures.Row('H.264: median', 10.0, 'ms', 14.0),
            figures.Row('H.264: median over limit', 1.2, '', 1.3),
            figures.Row('H.264: images', 30.0, '1/s', 29.0, 'more')]
    values, limits, targets = figures.plots.panels('streaming', rows)
    assert [(p.label, p.at, p.high, p.target) for p in values[1]] == [
        ('raw', 900.0, 1200.0, None), ('H.264', 10.0, 10.0, 14.0)]
    assert [(p.label, p.at, p.target) for p in limits[1]] == [('H.264', 1.2, 1.3)]
    assert [p.label for p in targets[1]] == ['H.264: images']


def test_axis_shows_all_points_with_round_ticks(figures: Any) -> None:
    rows = [figures.Row(f'{at}: median', at, 'ms', 50.0) for at in (0.02, 3.0, 500.0)]
    (_, points), = figures.plots.panels('streaming', rows)
    low, high = figures.plots.span(points, False)
    assert low < 0.02 and high > 500
    assert list(figures.plots.ticks(low, high)) == pytest.approx([0.1, 1, 10, 100])
    near = points[1:2]
    low, high = figures.plots.span(near, True)
    assert high / low >= 3 and low < 1
    assert {1.0, 3.0} <= {round(tick, 6) for tick in figures.plots.ticks(1, 3.1)}


@pytest.mark.parametrize('name', STORED)
def test_table_is_of_the_stored_figures(figures: Any, name: str) -> None:
    assert figures.table(name, figures.heading(name)) == (
        figures.RESULTS / f'{name}.md').read_text(), 'make pictures writes it'


def test_pictures_are_of_the_stored_figures(figures: Any) -> None:
    drawn = {path.stem for path in figures.RESULTS.glob('*.png')}
    assert drawn == figures.plots.PANELS.keys() & STORED
    for name in drawn:
        mark = figures.plots.mark(name, figures.stored(name)[1]).encode()
        assert mark in (figures.RESULTS / f'{name}.png').read_bytes(), \
            f'make pictures draws {name}.png'


def test_each_panel_shows_rows_of_stored_figures(figures: Any) -> None:
    shown = [panel for name in figures.plots.PANELS.keys() & STORED
             for panel, points in figures.plots.panels(name, figures.stored(name)[1])
             if len(points) > 1]
    for name, panels in figures.plots.PANELS.items():
        assert [panel.heading for panel in panels if panel not in shown] == [], name


def test_picture_is_drawn_from_the_rows(figures: Any, tmp_path: Path) -> None:
    pytest.importorskip('matplotlib', reason='the extra "applications" is not installed')
    rows = [figures.Row.of('raw: median', [900.0, 1000.0], 'ms'),
            figures.Row('H.264: median', 15.0, 'ms', 14.0),
            figures.Row('H.264: median over limit', 1.2, '', 1.3),
            figures.Row('H.264: images', 0.0, '1/s', 29.0, 'more')]
    figures.write('streaming', 'Streams', rows, tmp_path, 'a computer')
    picture = (tmp_path / 'streaming.png').read_bytes()
    assert picture.startswith(b'\x89PNG')
    assert figures.plots.mark('streaming', rows).encode() in picture
    assert '![Streams](streaming.png)' in (tmp_path / 'streaming.md').read_text()
    figures.write('chaos', 'Killed', rows, tmp_path, 'a computer')
    assert not (tmp_path / 'chaos.png').exists()
    assert '.png' not in (tmp_path / 'chaos.md').read_text()
