# SPDX-License-Identifier: Apache-2.0
"""Stored results are what the benchmarks write."""

from __future__ import annotations

import importlib
from pathlib import Path
import sys
from typing import Any

import pytest

from image_transport_h264.cdr import Header, Writer

FOLDER = Path(__file__).parents[2] / 'benchmarks'
RESULTS = FOLDER / 'results'


@pytest.fixture
def benchmark_modules(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that imports a module of the benchmarks."""
    monkeypatch.setattr(sys, 'path', [str(FOLDER), *sys.path])
    return importlib.import_module


def test_tables_show_stored_figures(benchmark_modules: Any, tmp_path: Path,
                                    monkeypatch: pytest.MonkeyPatch) -> None:
    figures = benchmark_modules('figures')
    monkeypatch.setattr(figures.plots, 'draw', lambda *words: None)
    applications, streaming = map(benchmark_modules, ('applications', 'streaming'))
    results = list(applications.before())
    outcomes = {name: streaming.stored(RESULTS / f'{name}-table.json')
                for name in ('streaming', 'streaming-video')}
    monkeypatch.setattr(figures, 'RESULTS', tmp_path)
    applications.write_down(results)
    for name, (rows, limits) in outcomes.items():
        page = (RESULTS / f'{name}-table.md').read_text()
        streaming.write_down(name, page.partition('\n')[0].removeprefix('# '), rows, limits)
    for path in tmp_path.glob('*-table.*'):
        assert path.read_text() == (RESULTS / path.name).read_text(), path.name


def test_time_of_a_stream_for_viewers_is_read(benchmark_modules: Any) -> None:
    shown = Writer().header(Header(7, 5, 'camera')).octets(b'frame').string('h264').data()
    assert benchmark_modules('monitor').sent_at('video', shown) == 7_000_000_005
