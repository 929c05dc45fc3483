# SPDX-License-Identifier: Apache-2.0
"""Configure the middleware on a machine, and start the router of one that needs it."""

from __future__ import annotations

from fogros2.deploy.context import Context
from fogros2.deploy.machine_job import MachineJob
from fogros2.deploy.robot_router import PAUSE
from fogros2.model import NodeSpec


def configure(context: Context, job: MachineJob) -> dict[str, str]:
    """Write the DDS configuration on the machine; return the variables that nodes need."""
    vendor, interface = context.dds, job.interface
    # how machines find each other depends on the middleware
    text = vendor.render(vendor.machine_interfaces(
        interface.address if vendor.by_address else interface.name), context.others())
    # users inside containers read it too; the folder's mode excludes other users
    job.shell.put(text.encode(), job.dds_file, mode=0o644, timeout=context.timeouts.command)
    return dict(vendor.environment(job.dds_file, {}))


def start_router(context: Context, job: MachineJob) -> None:
    """Start the router of the machine's nodes, for a middleware that has one."""
    router = context.dds.router(job.interface.address, context.others(), None)
    if router is None:
        return
    node = NodeSpec(
        id=f'{job.name}/router', name='router', package=router.package,
        executable=router.executable, files={'router.json5': router.config},
        environment={router.variable: ({'file': 'router.json5'},)},
        respawn=True, respawn_delay=PAUSE)
    job.agent.request('start', nodes=[node])
