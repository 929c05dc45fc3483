# SPDX-License-Identifier: Apache-2.0
"""Launch descriptions from launch files in XML."""
from launch.launch_description_sources import FrontendLaunchDescriptionSource

from .parser import Parser

__all__ = ['XMLLaunchDescriptionSource']


class XMLLaunchDescriptionSource(FrontendLaunchDescriptionSource):
    """A launch file in XML."""

    _method = 'interpreted XML launch file'
    _parser = Parser
