# SPDX-License-Identifier: Apache-2.0
"""Bring one machine up, step by step; its undo stack later takes the running machine down."""

from __future__ import annotations

from concurrent.futures import (
    FIRST_COMPLETED,
    FIRST_EXCEPTION,
    Future,
    ThreadPoolExecutor,
    wait,
)
import contextlib
import functools
from typing import Any

from fogros2 import feature, plan
from fogros2.deploy.context import Context, programs_of
from fogros2.deploy.machine_job import MachineJob
from fogros2.deploy.running import RunningMachine
from fogros2.deploy.steps import dds, installing
from fogros2.deploy.steps.arming import Arming
from fogros2.deploy.steps.connecting import Connection
from fogros2.deploy.steps.creating import Creation
from fogros2.deploy.steps.joining import Joined, Joining
from fogros2.deploy.steps.watching import ClockComparison
from fogros2.deploy.undo import NODES
from fogros2.host.bootstrap import RosInstall
from fogros2.model import MachineSpec


def bring_up(context: Context, spec: MachineSpec) -> RunningMachine:
    """
    Run all steps of a machine; on a failure, undo the steps that were started.

    :raises FogError: a step failed.
    """
    machine = RunningMachine(context, spec)
    with contextlib.ExitStack() as failed:
        failed.push(machine.undo)
        _run(context, machine)
        failed.pop_all()
        return machine


def _run(context: Context, job: RunningMachine) -> None:
    job.undo.enter_context(context.store.lock(job.name, cancel=job.cancel))
    connection, arming = Connection(context, job), Arming(context, job)
    joining = (Joining if context.other_vpn is None else Joined)(context, job)
    # the robot's VPN interface needs nothing from the machine: it comes up in parallel
    with ThreadPoolExecutor(6, f'fog-{job.name}') as pool:
        robot = pool.submit(context.vpn.ensure)
        Creation(context, job).run()
        connection.open()
        joining.choose_interface()
        armed = pool.submit(arming.arm)
        planned: Future[RosInstall] = Future()
        # looks at the machine meanwhile, and changes nothing before the watchdog is armed
        ros_step = pool.submit(
            installing.install_ros, context, job, armed.result, planned.set_result)
        wait([planned, ros_step], return_when=FIRST_COMPLETED)
        # in parallel with the installation on the machine
        try:
            ros = planned.result() if planned.done() else ros_step.result()
            robot.result()
            joining.avoid(ros.facts)
        except BaseException:
            job.cancel.set()
            raise
        job.modules = installing.Modules(context, job, ros)
        vpn_step = pool.submit(joining.join)
        dds_step = pool.submit(dds.configure, context, job)

        def install_modules() -> None:
            ros_step.result()
            job.modules.ensure(programs_of(context.nodes))

        def use_features() -> None:
            ros_step.result()
            for each, own in feature.used(job.spec):
                each.installing(job, context.nodes, own)

        _wait_for_all(
            job, ros_step, vpn_step, dds_step,
            pool.submit(installing.send_workspaces, context, job, ros, ros_step.result),
            pool.submit(install_modules), pool.submit(use_features))
    used = list(zip(feature.names(job.spec), feature.used(job.spec)))
    for name, (each, own) in used:
        for link in joining.links(connection):
            carrying = contextlib.ExitStack()
            job.undo.add(name, carrying.close)
            carrying.enter_context(each.vpn(link, own))
    job.environment = plan.extended(
        {**ros.environment, **dds_step.result()}, job.spec.environment)
    with job.step('agent') as detail:
        arming.start_heartbeat(ros.setup, job.environment)
        detail.append(f'VPN round trip {(job.heartbeat.round_trip or 0) * 1e3:.2f} ms')
    # pushed now, so that they end after the nodes and before the machine
    endings = [contextlib.ExitStack() for _ in used]
    for ending, (name, _) in zip(endings, used):
        job.may_make(name)
        job.undo.add(name, ending.close)
    # a second time, so that the nodes stop first on the way down
    job.push(NODES)
    start_router = functools.partial(dds.start_router, context, job)
    start_router()
    job.restoring = (joining.restore, start_router, arming.watch_notice)
    connection.enter_vpn()
    job.undo.callback(ClockComparison(job.name, job.heartbeat, context.report).close)
    job.undo.callback(job.ending.set)
    for ending, (_, (each, own)) in zip(endings, used):
        ending.enter_context(each.machine(job, own))
    job.begin(joining.redial)


def _wait_for_all(job: MachineJob, *tasks: Future[Any]) -> None:
    """Wait for parallel steps; the first failure cancels the others."""
    for task in wait(tasks, return_when=FIRST_EXCEPTION).done:
        if task.exception() is not None:
            job.cancel.set()
            task.result()
