# SPDX-License-Identifier: Apache-2.0
"""The index of what is installed: packages and other resources below prefixes."""

from ament_index_python.constants import RESOURCE_INDEX_SUBFOLDER as RESOURCE_INDEX_SUBFOLDER
from ament_index_python.packages import *  # noqa: F403
from ament_index_python.resources import *  # noqa: F403
from ament_index_python.search_paths import get_search_paths as get_search_paths
from rosidl_embedded.lacking import lacking

__getattr__ = lacking(__name__, 'get_resource_types')
