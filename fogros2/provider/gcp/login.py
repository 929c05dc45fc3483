# SPDX-License-Identifier: Apache-2.0
"""Whether this computer is set up for Google Cloud; loaded without the rest of the package."""

from __future__ import annotations

import os
from pathlib import Path

#: Names the file of the credentials.
VARIABLE = 'GOOGLE_APPLICATION_CREDENTIALS'


def credentials() -> Path:
    """Return the file of the credentials; it may not exist."""
    named = os.environ.get(VARIABLE, '')
    folder = Path(os.environ.get('CLOUDSDK_CONFIG') or '~/.config/gcloud').expanduser()
    return Path(named) if named else folder / 'application_default_credentials.json'


def configured() -> bool:
    """Return whether Google Cloud is set up here; read only files and variables."""
    return bool(os.environ.get(VARIABLE)) or credentials().is_file()
