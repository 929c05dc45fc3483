# SPDX-License-Identifier: Apache-2.0
"""Tests that hold for ROS 2 and for the embedded default alike."""

import contextlib
import os

from rigs.domains import taken

# before anything of ROS is imported
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
_held = contextlib.ExitStack()
os.environ['ROS_DOMAIN_ID'] = _held.enter_context(taken())  # until this process ends
# this computer and nothing else
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
for name in ('RMW_IMPLEMENTATION', 'ROS_STATIC_PEERS', 'ROS_LOCALHOST_ONLY'):
    os.environ.pop(name, None)
os.environ['RCUTILS_COLORIZED_OUTPUT'] = '0'
