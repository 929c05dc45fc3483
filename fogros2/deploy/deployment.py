# SPDX-License-Identifier: Apache-2.0
"""Bring one machine up, step by step; its undo stack later takes the running machine down."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import (
    FIRST_COMPLETED,
    FIRST_EXCEPTION,
    Future,
    ThreadPoolExecutor,
    wait,
)
import json
from typing import Any, TYPE_CHECKING

from fogros2 import bootstrap, workspace
from fogros2.agent_client import AgentClient
from fogros2.deploy import routing
from fogros2.deploy.beside import Containers
from fogros2.deploy.comparing import Comparison
from fogros2.deploy.creating import Creation
from fogros2.deploy.entering import Entrance
from fogros2.deploy.equipping import Equipment
from fogros2.deploy.guarding import Guard
from fogros2.deploy.job import Job
from fogros2.deploy.joining import Joining
from fogros2.deploy.running import RunningMachine
from fogros2.errors import DdsError
from fogros2.model import MachineSpec, to_json, VpnInterface
from fogros2.report import Progress
from fogros2.shell import Shell

if TYPE_CHECKING:
    from fogros2.deploy.launch import Launch


class Deployment:
    """The steps of one machine."""

    def __init__(self, launch: Launch, spec: MachineSpec) -> None:
        self.launch = launch
        self.job = Job(launch, spec)
        self.creation = Creation(self.job)
        self.entrance = Entrance(self.job)
        self.guard = Guard(self.job)
        self.joining = Joining(self.job, self.guard)

    def run(self) -> RunningMachine:
        """Run all steps; on a failure, undo the steps that were started."""
        job = self.job
        with job.undo:
            job.undo.enter_context(job.folder.lock())
            # the robot's VPN interface needs nothing from the machine: it comes up in parallel
            with ThreadPoolExecutor(6, f'fog-{job.name}') as pool:
                robot = pool.submit(self.launch.robot_vpn().ensure)
                machine = self.creation.run()
                shell = self.entrance.connect(machine)
                interface = self.joining.interface()
                agent = self.guard.arm(machine, shell)
                robot.result()
                planned: Future[bootstrap.RosInstall] = Future()
                installing = pool.submit(self.prepare_host, shell, planned.set_result)
                wait([planned, installing], return_when=FIRST_COMPLETED)
                ros = planned.result() if planned.done() else installing.result()
                # in parallel with the installation on the machine
                with job.failing():
                    interface = self.joining.fit(interface, ros.facts.routes)
                joining = pool.submit(self.joining.join, machine, shell, agent, interface)
                syncing = pool.submit(self.sync, shell, ros, installing)
                configuring = pool.submit(self.configure_dds, shell, interface)
                equipment = Equipment(job, shell, ros)
                equipping = pool.submit(_after, installing, self.equip, equipment)
                containers = Containers(job, shell, self.guard.directory, self.configuration)

                def environment() -> dict[str, str]:
                    joining.result()
                    return {**ros.environment, **configuring.result(), **job.spec.environment}

                starting = pool.submit(_after, installing, containers.start, environment)
                self._all_of(
                    installing, joining, syncing, configuring, equipping, starting)
                public_key = joining.result().place.peer.public_key
                dds = configuring.result()
            with job.step('agent') as detail:
                heartbeat = self.guard.start(agent, interface, ros, dds)
                detail.append(f'VPN round trip {(heartbeat.round_trip or 0) * 1e3:.2f} ms')
            job.save(public_key=public_key)
            # pushed a second time, so that the nodes stop first on the way down
            self.guard.undo_nodes(agent)
            self.start_router(agent, interface)
            self.entrance.go_inside(interface)
            job.undo.callback(Comparison(job.name, heartbeat, self.launch.report).close)
            job.failed = False
            running = RunningMachine(
                self.launch, job, machine, shell, agent, heartbeat, interface,
                self.guard.first_event, self.joining.redial, equipment, containers)
            running.undo = job.undo.pop_all()
            return running

    def _all_of(self, *tasks: Future[Any]) -> None:
        """Wait for parallel steps; the first failure cancels the others."""
        for task in wait(tasks, return_when=FIRST_EXCEPTION).done:
            if task.exception() is not None:
                self.job.cancel.set()
                task.result()

    # -- step 4: ROS on the machine -------------------------------------------------------------

    def prepare_host(
        self, shell: Shell, on_plan: Callable[[bootstrap.RosInstall], object],
    ) -> bootstrap.RosInstall:
        """Install what ROS 2 nodes need on the machine; see :func:`fogros2.bootstrap.ensure`."""
        job = self.job
        with job.step('ROS 2') as detail:
            ros, note = bootstrap.ensure(
                shell, self.launch.underlay(job.spec.workspaces), job.spec,
                timeout=job.timeouts.install, cancel=job.cancel, on_plan=on_plan,
                elsewhere=True,
                packages=sorted({package for package, _ in self.launch.programs(job.name)}))
            detail.append(note)
            return ros

    def equip(self, equipment: Equipment) -> None:
        """Install what the known programs import; programs that start later add theirs."""
        equipment.ensure(self.launch.programs(self.job.name))

    # -- steps 6 and 7: workspace, DDS ----------------------------------------------------------

    def sync(
        self, shell: Shell, ros: bootstrap.RosInstall, installed: Future[bootstrap.RosInstall],
    ) -> None:
        """Send the workspaces; build them on the machine if needed, after the installation."""
        job = self.job
        if job.spec.workspace is None:
            return
        with job.step('workspace') as detail:
            note = workspace.transfer(
                shell, ros.workspaces, timeouts=job.timeouts,
                cancel=job.cancel, before_build=installed.result,
                on_progress=lambda done, total: self.launch.report(
                    Progress(job.name, 'workspace', done, total)))
            detail += [note, *workspace.left_behind(
                self.launch.user_environment, job.spec.workspaces)]

    @property
    def configuration(self) -> str:
        """The path of the middleware's configuration on the machine."""
        return f'{self.guard.directory}/{self.launch.dds().file_name}'

    def configure_dds(self, shell: Shell, interface: VpnInterface) -> dict[str, str]:
        """Write the DDS configuration on the machine; return the variables that nodes need."""
        vendor = self.launch.dds()
        # the robot finds a machine by multicast; machines find each other by unicast to peers
        peers = self.launch.addresses_but(self.job.name)
        path = self.configuration
        shell.put(
            vendor.render(vendor.machine_interfaces(
                interface.address if vendor.by_address else interface.name), peers).encode(),
            # users inside containers read it too; the folder's mode excludes other users
            path, mode=0o644, timeout=self.job.timeouts.command)
        return dict(vendor.environment(path, {}))

    def start_router(self, agent: AgentClient, interface: VpnInterface) -> None:
        """Start the router of the machine's nodes, for a middleware that has one."""
        name = self.job.name
        router = self.launch.dds().router(
            interface.address, self.launch.addresses_but(name), None)
        if router is None:
            return
        if self.launch.index(name) >= routing.MACHINES:
            raise DdsError(
                f"'{name}' is one machine too many: the robot's router knows {routing.MACHINES}",
                'spread them over several launches, or use another RMW_IMPLEMENTATION')
        agent.request('start', nodes=[json.loads(to_json(routing.node(router, name)))])


def _after(ready: Future[bootstrap.RosInstall], do: Callable[..., None], *words: Any) -> None:
    """Call a function after ROS 2 is installed; raise the error of the installation."""
    ready.result()
    do(*words)
