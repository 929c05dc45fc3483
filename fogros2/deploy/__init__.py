# SPDX-License-Identifier: Apache-2.0
"""
Create machines from specs, run nodes on them, and delete the machines again.

A :class:`Launch` is the robot's side of one launch. :meth:`Launch.up` takes one machine through
the steps of the paper. Several machines come up in parallel, each in a thread of the caller.
Each step pushes its undo before it runs. The modules, each imports only those before it:

``undo``          undo steps; one that fails does not stop the others
``robot``         programs and rights that this computer needs
``robot_vpn``     the robot's VPN interface; ``robot_router``: the router beside its nodes
``choosing``      choices of the providers before anything is created, and prices
``checks``        checks before anything is created
``context``       what the steps of one machine use
``life``          the phases of a machine, and how it ends in each
``machine_job``   what the steps of one machine learn and change, and how they are undone
``steps``         a module for each step
``running``       a machine that is up
``deployment``    the order of the steps
``launch``        what all machines share; the end of a launch
"""

from fogros2.deploy.launch import Launch
from fogros2.deploy.robot import (
    check_net_admin,
    check_robot,
    check_sudo,
    firewall_trouble,
    kernel_wireguard,
    provider,
    ROBOT_PROGRAMS,
    TUN,
    TUN_REMEDY,
)
from fogros2.deploy.running import RunningMachine

__all__ = [
    'check_net_admin', 'check_robot', 'check_sudo', 'firewall_trouble', 'kernel_wireguard',
    'Launch', 'provider', 'ROBOT_PROGRAMS', 'RunningMachine', 'TUN', 'TUN_REMEDY',
]
