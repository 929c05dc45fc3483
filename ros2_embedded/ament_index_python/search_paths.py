# SPDX-License-Identifier: Apache-2.0
"""The prefixes that are searched."""

from functools import lru_cache
import os
from pathlib import Path
import sys

from ament_index_python.constants import AMENT_PREFIX_PATH_ENV_VAR, RESOURCE_INDEX_SUBFOLDER


@lru_cache(maxsize=None)
def _own_prefixes() -> list[str]:
    """Give the prefixes the embedded default itself is installed in, as an underlay."""
    beside = [str(parent) for parent in Path(__file__).resolve().parents]
    return [prefix for prefix in dict.fromkeys([sys.prefix, *beside])
            if os.path.isdir(os.path.join(prefix, RESOURCE_INDEX_SUBFOLDER))]


def get_search_paths() -> list[str]:
    """
    List the prefixes of AMENT_PREFIX_PATH, and after them the interpreter's.

    :raises EnvironmentError: if there is none.
    """
    given = os.environ.get(AMENT_PREFIX_PATH_ENV_VAR, '').split(os.pathsep)
    paths = [path for path in dict.fromkeys([*given, *_own_prefixes()])
             if path and os.path.exists(path)]
    if not paths:
        raise EnvironmentError(
            f"Environment variable '{AMENT_PREFIX_PATH_ENV_VAR}' is not set or empty")
    return paths
