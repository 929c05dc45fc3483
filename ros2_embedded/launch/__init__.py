# SPDX-License-Identifier: Apache-2.0
"""Starts, watches and stops processes as a launch description says: ROS 2 Jazzy's API."""
from . import _aliases as _aliases
from . import actions as actions
from . import conditions as conditions
from . import descriptions as descriptions
from . import event_handlers as event_handlers
from . import events as events
from . import frontend as frontend
from . import launch_description_sources as launch_description_sources
from . import logging as logging
from . import substitutions as substitutions
from ._base import *  # noqa: F403
from .launch_context import LaunchContext as LaunchContext
from .launch_description import LaunchDescription as LaunchDescription
from .launch_description import LaunchDescriptionSource as LaunchDescriptionSource
from .launch_introspector import LaunchIntrospector as LaunchIntrospector
from .launch_service import LaunchService as LaunchService
