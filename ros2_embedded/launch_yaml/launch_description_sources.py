# SPDX-License-Identifier: Apache-2.0
"""Launch descriptions from launch files in YAML, and whatever else a frontend reads."""
from launch.launch_description_sources import (
    FrontendLaunchDescriptionSource as YAMLLaunchDescriptionSource,
)

__all__ = ['YAMLLaunchDescriptionSource']
