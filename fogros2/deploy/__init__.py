# SPDX-License-Identifier: Apache-2.0
"""
The one orchestrator: from machine specs to machines that run nodes, and back to nothing.

A :class:`Launch` is the robot's side of one launch. :meth:`Launch.up` takes one machine through
the steps of the paper; several run in parallel, each in a thread of its caller. Every undo is
pushed before its step runs. In the order of the steps:

``launch``      what all machines share, checks before anything is created, the way down
``choosing``    what providers choose before anything is created, and what it costs
``robot``       what this computer needs to have; ``robot_vpn``: its VPN interface
``deployment``  one machine's way up, step by step; ``job``: what its steps share
``creating``    steps 1 to 3: create or take a kept one, wait until it can be reached
``entering``    log in, give the machine a host key of its own, close the way in behind the VPN
``guarding``    the agent, armed before anything slow; nodes and heartbeat
``joining``     step 5: the machine's end of the VPN
``running``     a machine that is up; ``watching``: whether it still exists
``comparing``   its clock beside the robot's
"""

from fogros2.deploy.launch import Launch
from fogros2.deploy.robot import check_robot, check_sudo, cleanup, provider, ROBOT_PROGRAMS
from fogros2.deploy.running import RunningMachine

__all__ = [
    'check_robot', 'check_sudo', 'cleanup', 'Launch', 'provider', 'ROBOT_PROGRAMS',
    'RunningMachine',
]
