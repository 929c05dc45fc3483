# SPDX-License-Identifier: Apache-2.0
"""Tests that hold for ROS 2 and for the embedded default alike."""

import contextlib
import os

from rigs.domains import taken

# before anything of ROS is imported
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['RMW_IMPLEMENTATION'] = 'rmw_cyclonedds_cpp'
_held = contextlib.ExitStack()
os.environ['ROS_DOMAIN_ID'] = _held.enter_context(taken())  # until this process ends
os.environ['CYCLONEDDS_URI'] = (  # this computer's loopback and nothing else
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    '<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto'
    '</ParticipantIndex><MaxAutoParticipantIndex>40</MaxAutoParticipantIndex><Peers>'
    '<Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>')
os.environ.pop('ROS_AUTOMATIC_DISCOVERY_RANGE', None)
os.environ.pop('ROS_STATIC_PEERS', None)
os.environ.pop('ROS_LOCALHOST_ONLY', None)
os.environ['RCUTILS_COLORIZED_OUTPUT'] = '0'
