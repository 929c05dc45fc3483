# SPDX-License-Identifier: Apache-2.0
"""Whether this computer is set up for Azure; loaded without the rest of the package."""

from __future__ import annotations

import os
from pathlib import Path


def configured() -> bool:
    """Return whether Azure is set up here; read only files and variables."""
    return bool(os.environ.get('AZURE_SUBSCRIPTION_ID')) or file('azureProfile.json').is_file()


def file(name: str) -> Path:
    """Return a file of the folder of ``az``; it may not exist."""
    return Path(os.environ.get('AZURE_CONFIG_DIR') or Path.home() / '.azure', name)
