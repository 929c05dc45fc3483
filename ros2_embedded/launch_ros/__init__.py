# SPDX-License-Identifier: Apache-2.0
"""What launch needs to know of ROS: ROS 2 Jazzy's API."""
from . import actions, descriptions, event_handlers, events, ros_adapters, substitutions

__all__ = [
    'actions', 'descriptions', 'event_handlers', 'events', 'ros_adapters', 'substitutions']
