# SPDX-License-Identifier: Apache-2.0
"""The documentation's site is built with Sphinx, without a warning."""

from __future__ import annotations

from pathlib import Path
import re
import subprocess
import sys

import pytest

from fogros2 import plugin_system

ROOT = Path(__file__).resolve().parents[2]


def test_site_is_built_without_a_warning():
    pytest.importorskip('myst_parser', reason='the extra "docs" is not installed')
    built = subprocess.run(
        [sys.executable, str(ROOT / 'tools/docs.py')], capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    page = re.sub('<[^>]*>', '', (ROOT / '.cache/docs/reference/command_line.html').read_text())
    for verb in plugin_system.names('fogros2.verb'):
        assert f'ros2 fog {verb}' in page
