# SPDX-License-Identifier: Apache-2.0
"""What launch needs to know of ROS: ROS 2 Jazzy's API."""
from . import actions
from . import descriptions
from . import event_handlers
from . import events
from . import ros_adapters
from . import substitutions

__all__ = [
    'actions', 'descriptions', 'event_handlers', 'events', 'ros_adapters', 'substitutions']
