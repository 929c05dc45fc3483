# SPDX-License-Identifier: Apache-2.0
"""Launch descriptions from launch files in YAML."""
from launch import SomeSubstitutionsType
from launch.launch_description_sources import FrontendLaunchDescriptionSource

from .parser import Parser

__all__ = ['YAMLLaunchDescriptionSource']


class YAMLLaunchDescriptionSource(FrontendLaunchDescriptionSource):
    """A launch file in YAML."""

    def __init__(self, launch_file_path: SomeSubstitutionsType) -> None:
        super().__init__(
            launch_file_path, method='interpreted YAML launch file', parser=Parser)
