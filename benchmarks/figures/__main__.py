# SPDX-License-Identifier: Apache-2.0
"""
Write the tables and pictures of benchmarks again, from the stored figures.

    cd benchmarks && python -m figures [NAME...]
"""

from __future__ import annotations

import sys

from figures import heading, names, show

for name in sys.argv[1:] or names():
    show(name, heading(name))
