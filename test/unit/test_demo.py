# SPDX-License-Identifier: Apache-2.0
"""The program of ``make demo``, by value."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import subprocess
import sys

import pytest

PROGRAM = Path(__file__).parents[2] / 'tools' / 'demo.py'


def test_command_line_may_be_no_text(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location('demo', PROGRAM)
    assert spec is not None and spec.loader is not None
    demo = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, 'demo', demo)  # its dataclass looks there
    spec.loader.exec_module(demo)
    monkeypatch.setattr(demo, 'output', lambda *words, root=False: '')
    with subprocess.Popen(['sh', '-c', 'echo; read line', b'caf\xe9'], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        traces = [*demo.traces()]
        child.communicate(b'\n')
    assert f'process {child.pid} sh -c echo; read line caf\ufffd' in traces
