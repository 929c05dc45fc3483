# SPDX-License-Identifier: Apache-2.0
"""Launch descriptions from launch files in YAML."""
from launch.launch_description_sources import FrontendLaunchDescriptionSource

from .parser import Parser

__all__ = ['YAMLLaunchDescriptionSource']


class YAMLLaunchDescriptionSource(FrontendLaunchDescriptionSource):
    """A launch file in YAML."""

    _method = 'interpreted YAML launch file'
    _parser = Parser
