# SPDX-License-Identifier: Apache-2.0
"""
Create machines from specs, run nodes on them, and delete the machines again.

A :class:`Launch` is the robot's side of one launch. :meth:`Launch.up` takes one machine through
the steps of the paper. Several machines come up in parallel, each in a thread of the caller.
Each step pushes its undo before it runs. The modules, in the order of the steps:
``launch``      what all machines share, checks before anything is created, the end of a launch
``choosing``    choices of the providers before anything is created, and prices
``robot``       programs and rights that this computer needs; ``robot_vpn``: its VPN interface
``deployment``  the steps of one machine; ``job``: what the steps share
``creating``    steps 1 to 3: create or reuse a machine, wait until it can be reached
``entering``    log in, replace the host key, move SSH into the VPN and close the SSH port
``guarding``    the agent, started before any slow step; nodes and heartbeat
``joining``     step 5: the machine's end of the VPN
``running``     a machine that is up; ``watching``: check that the machine still exists
``comparing``   compare the machine's clock with the robot's
"""

from fogros2.deploy.launch import Launch
from fogros2.deploy.robot import check_robot, check_sudo, cleanup, provider, ROBOT_PROGRAMS
from fogros2.deploy.running import RunningMachine

__all__ = [
    'check_robot', 'check_sudo', 'cleanup', 'Launch', 'provider', 'ROBOT_PROGRAMS',
    'RunningMachine',
]
