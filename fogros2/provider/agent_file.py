# SPDX-License-Identifier: Apache-2.0
"""Where this installation keeps the agent, for providers whose machines boot with it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Optional


def agent_file() -> Optional[Path]:
    """Return the agent's program without importing it, None where the installation lacks it."""
    spec = importlib.util.find_spec('fogros2')
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder, 'agent.py')
        if path.is_file():
            return path
    return None
