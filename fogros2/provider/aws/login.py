# SPDX-License-Identifier: Apache-2.0
"""Whether this computer is set up for AWS; loaded without the rest of the package."""

from __future__ import annotations

import os
from pathlib import Path

#: Variables and files that show that AWS is set up on this computer.
_VARIABLES = (
    'AWS_ACCESS_KEY_ID', 'AWS_PROFILE', 'AWS_DEFAULT_PROFILE', 'AWS_WEB_IDENTITY_TOKEN_FILE',
    'AWS_CONTAINER_CREDENTIALS_RELATIVE_URI', 'AWS_CONTAINER_CREDENTIALS_FULL_URI')
_FILES = {'AWS_SHARED_CREDENTIALS_FILE': '~/.aws/credentials', 'AWS_CONFIG_FILE': '~/.aws/config'}


def configured() -> bool:
    """Return whether AWS is set up here; read only files and variables."""
    if any(os.environ.get(name) for name in _VARIABLES):
        return True
    return any(Path(os.environ.get(variable) or usual).expanduser().is_file()
               for variable, usual in _FILES.items())
