# SPDX-License-Identifier: Apache-2.0
"""What the nodes' programs say where modules or images are missing."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]


def test_a_missing_module_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    (tmp_path / 'av.py').write_text("raise ModuleNotFoundError('none', name='av')\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, str(ROOT / 'image_transport_h264/scripts/encoder')], timeout=30,
        env={**os.environ, 'PYTHONPATH': path}, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith('av is not installed here: pip install av')
    assert len(done.stderr.splitlines()) == 1
