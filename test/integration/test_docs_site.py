# SPDX-License-Identifier: Apache-2.0
"""The documentation's site is built with Sphinx, without a warning."""

from __future__ import annotations

import json
from pathlib import Path
import re
import subprocess
import sys

import pytest

from fogros2 import plugin_system

ROOT = Path(__file__).resolve().parents[2]


def test_site_is_built_without_a_warning():
    pytest.importorskip('myst_parser', reason='the extra "docs" is not installed')
    # the theme takes as long as all else
    built = subprocess.run(
        [sys.executable, str(ROOT / 'tools/docs.py'), '-D', 'html_theme=basic'],
        capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    site = ROOT / '.cache/docs'
    page = re.sub('<[^>]*>', '', (site / 'reference/command_line.html').read_text())
    for verb in plugin_system.names('fogros2.verb'):
        assert f'usage: ros2 fog {verb}' in page
    footer = (site / 'howto/machines.html').read_text().rpartition('class="left-details"')[2]
    assert 'Apache-2.0' in footer and 'issues"' in footer
    assert 'href="../install.html#get-a-version"' in footer
    # the index of the search
    index = json.loads(re.search(r'{.*}', (site / 'searchindex.js').read_text(), re.DOTALL)[0])
    found = {index['docnames'][number] for number in index['terms']['timeout']}
    assert {'reference/glossary', 'troubleshooting'} <= found
