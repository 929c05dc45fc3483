# SPDX-License-Identifier: Apache-2.0
"""What the benchmark of streams says of a run that gave no result, and what it keeps."""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path
import subprocess
import sys
from typing import Any

import pytest

PATH = Path(__file__).parents[2] / 'benchmarks/streaming.py'


@pytest.fixture
def streaming(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import the benchmark, which is a program."""
    monkeypatch.setattr(sys, 'path', [str(PATH.parent), *sys.path])
    spec = importlib.util.spec_from_file_location('benchmark_streaming', PATH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def child(text: str) -> subprocess.Popen[str]:
    """Start a Python program whose output is read."""
    return subprocess.Popen([sys.executable, '-c', text], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize('printed', ['', 'no JSON'])
def test_child_without_result_shows_its_errors(streaming: Any, printed: str) -> None:
    process = child(f'print({printed!r}); raise SystemExit("no camera found")')
    with pytest.raises(RuntimeError, match=r'(?s)the camera gave no result \(exit status 1\)'
                       '.*no camera found'):
        streaming.answer_of(process, 'the camera', 20)


def test_last_output_and_end_of_nodes_are_known(streaming: Any) -> None:
    output = streaming.Output()
    for number in range(streaming.LAST_LINES + 5):
        output.heard({'event': 'output', 'node': 'cloud-0', 'stream': 'stderr',
                      'text': f'line {number}\n'})
    output.heard({'event': 'exited', 'node': 'cloud-0', 'returncode': 1})
    output.heard({'event': 'refused', 'node': 'decoder-0', 'error': 'no such program'})
    last = output.last('cloud-0', 'decoder-0').splitlines()
    assert len(last) == streaming.LAST_LINES + 1
    assert last[-2:] == [f'cloud-0: line {streaming.LAST_LINES + 4}',
                         'decoder-0: no such program']
    assert output.ended == {'cloud-0', 'decoder-0'}


def test_measured_rows_replace_earlier_ones(streaming: Any, tmp_path: Path) -> None:
    def outcome(at: int, fps: float) -> Any:
        return streaming.Outcome(
            streaming.CASES[at], fps, 1.0, 1.0, 1.0, 0, 1.0, math.nan, 1.0, 1.0, 1.0, 1.0)

    path = tmp_path / 'table.json'
    rows = [streaming.dataclasses.asdict(outcome(at, 1.0)) for at in (1, 0)]
    rows[1]['psnr'] = None
    path.write_text(json.dumps({'limits': {'H.264': 7.0}, 'rows': rows}))
    earlier, limits = streaming.stored(path)
    found = streaming.merged([outcome(1, 24.0)], earlier)
    assert [(o.case.name, o.fps) for o in found] == [
        ('raw', 1.0), ('compressed, JPEG 80', 24.0)]
    assert math.isnan(found[0].psnr)
    assert limits == {'H.264': 7.0}
