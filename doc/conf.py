# SPDX-License-Identifier: Apache-2.0
"""Sphinx's configuration; rosdoc2 takes it as it is."""

from __future__ import annotations

from pathlib import Path
import sys
import xml.etree.ElementTree as ElementTree

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

project = 'FogROS2'
author = 'FogROS2 maintainers'
manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
release = manifest.findtext('version') or ''
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.intersphinx',
              'sphinx.ext.viewcode']
# nothing is fetched: references to others' documentation stay plain text
intersphinx_mapping: dict[str, tuple[str, str]] = {}
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
myst_heading_anchors = 4
myst_enable_extensions = ['colon_fence', 'deflist']
html_theme = 'furo'
html_title = f'FogROS2 {release}'
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
templates_path = ['_templates']
# for the footer
html_context = {'licence': manifest.findtext('license'),
                'issues': manifest.findtext('url[@type="bugtracker"]')}
exclude_patterns = ['_build']
autodoc_member_order = 'bysource'
autodoc_typehints = 'signature'
autodoc_class_signature = 'mixed'
# ROS 2's own classes, as far as they are named, are documented elsewhere
nitpicky = False
