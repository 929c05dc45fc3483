# SPDX-License-Identifier: Apache-2.0
"""Run a Python module as ``python -m`` does, but import nothing of the current folder."""

from __future__ import annotations

import sys

#: Command; its next arguments are the module and the module's arguments. The current folder may
#: have modules of other accounts, and ``-m`` would search it before the standard library.
RUN_MODULE = (sys.executable, '-c', 'import sys; sys.path[:] = filter(None, sys.path); '
              'import runpy; runpy.run_module(sys.argv.pop(1), run_name="__main__", '
              'alter_sys=True)')
