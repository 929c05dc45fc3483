# SPDX-License-Identifier: Apache-2.0
"""The Python module that the bridge and the recorder import besides ROS 2."""

from __future__ import annotations

from fogros2.host.modules import Module

_FOXGLOVE = (Module('foxglove', ('foxglove-sdk',), (0, 30)),)
NEEDS = {'bridge': _FOXGLOVE, 'record': _FOXGLOVE}
