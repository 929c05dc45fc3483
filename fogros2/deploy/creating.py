# SPDX-License-Identifier: Apache-2.0
"""Steps 1 to 3: create a machine or reuse a kept one, and wait until it runs."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from pathlib import Path
import time
from typing import Any, Optional
import uuid

from fogros2 import bootstrap, model, monitor_addresses, plan, process
from fogros2.deploy.job import Job
from fogros2.errors import (
    ConfigurationError,
    FogError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    Unsupported,
)
from fogros2.model import Command, CreateRequest, Machine, MachineState
from fogros2.provider import (
    Provider,
    TAG_DEPENDENCIES,
    TAG_EXPIRES,
    TAG_LAUNCH,
    TAG_NAME,
    TAG_ON_EXIT,
    TAG_ROBOT,
)
from fogros2.store import boot_id, process_start, robot_name


class Creation:
    """Create or reuse the machine of a deployment, and end it by its ``on_exit``."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._asked = self._refused = False

    def run(self) -> Machine:
        """
        Create or reuse the machine; return it when a connection can be tried.

        :raises NameTaken: another launch uses the name, or the kept machine has other options.
        :raises ProviderError: the provider refused, or the machine ended while it started.
        """
        job = self._job
        with job.step('machine') as detail:
            kept = self._kept()
            if kept is not None:
                self._adopt(kept)
                detail.append('kept from before')
            else:
                self._create()
            choices = job.launch.choices
            price = choices.price(job.spec)
            choices.begin(job.name, price)
            machine = job.provider.reachable(
                job.machine_id, name=job.name, timeout=job.timeouts.boot, cancel=job.cancel)
            if machine.cost_per_hour is not None:
                price = machine.cost_per_hour
                choices.begin(job.name, price)
            if price is not None:
                detail.append(plan.price(price))
            job.save(shell=machine.shell)
            detail.append(machine.shell.host if machine.shell else machine.id[:20])
            if machine.note:
                detail.append(machine.note)
            return machine

    # -- a kept machine -------------------------------------------------------------------------

    def _kept(self) -> Optional[Machine]:
        """Return the machine of this name that an earlier launch kept or stopped, or None."""
        job = self._job
        if job.folder.exists():
            before = job.folder.load()
            if before.launch_alive:
                raise NameTaken(
                    f"the launch with process {before.pid} has the machine '{job.name}'",
                    'give the machine another name=, or end that launch')
            if before.provider != job.spec.provider:
                raise NameTaken(
                    f"'{job.name}' is a machine of the provider '{before.provider}'",
                    f'give the machine another name=, or: ros2 fog delete {job.name}')
            if before.machine_id is not None:
                with contextlib.suppress(MachineNotFound):
                    machine = job.provider.describe(before.machine_id)
                    if machine.state is not MachineState.DELETED:
                        self._check_alike(before.asked_options, machine)
                        # the earlier choices still hold; everything else comes from this launch
                        job.spec = dataclasses.replace(job.spec, options=before.spec.options)
                        job.record = dataclasses.replace(before, spec=job.spec)
                        job.former = before.last or before.launch
                        return machine
        # ``create`` finds and refuses a machine that this robot has no record of
        return None

    def _check_alike(self, before: Any, machine: Machine) -> None:
        """Raise if the kept machine was created with other options than this launch asks for."""
        job = self._job
        then, now = (json.loads(model.to_json(o)) for o in (before, job.spec.options))
        other = sorted(key for key in {*then, *now} if then.get(key) != now.get(key))
        if other:
            raise NameTaken(
                f"the machine '{job.name}' of an earlier launch has another {', '.join(other)}",
                f'give the machine another name=, or: ros2 fog delete {job.name}')
        if job.spec.on_exit == 'stop' and type(job.provider).adopt is Provider.adopt \
                and machine.tags.get(TAG_ON_EXIT, 'stop') != 'stop':
            raise ConfigurationError(
                f"the machine '{job.name}' was not made to be stopped and started",
                f"keep it with on_exit='keep', or: ros2 fog delete {job.name}")

    def _adopt(self, machine: Machine) -> None:
        job = self._job
        job.reused = True
        job.undoing('end', self._end)
        before = job.record
        self._claim(job.record.token)
        job.provider.adopt(machine.id, job.spec, self._tags())
        if before.monitor_open:
            # left open by a launch that was killed
            job.provider.publish(machine, monitor_addresses.guarded_port(before.monitor), ())
        if machine.state in (MachineState.STOPPED, MachineState.STOPPING):
            job.provider.start(machine.id)

    # -- a new machine --------------------------------------------------------------------------

    def _create(self) -> None:
        job = self._job
        job.spec = job.launch.choices.resolved(job.spec)
        token = str(uuid.uuid4())
        job.folder.delete()
        job.record = dataclasses.replace(job.record, spec=job.spec)
        job.undoing('end', self._end)
        self._claim(token)
        config: dict[str, Any] = {}
        if job.provider.agent_directory:
            config = plan.agent_config(
                job.spec, job.launch.id, job.provider.agent_directory, [])
            config['boot_timeout'] = job.timeouts.boot + job.timeouts.ssh
        dependencies = self._dependencies()
        tags = {
            TAG_NAME: job.name, TAG_ROBOT: robot_name(), **self._tags(),
            **({TAG_DEPENDENCIES: dependencies} if dependencies else {}),
        }
        key = self._login_key() if job.provider.owned and job.provider.shell_kind == 'ssh' else ''
        self._asked = True
        try:
            machine_id = job.provider.create(job.spec, CreateRequest(
                token=token, authorized_key=key, tags=tags,
                vpn_port=plan.machine_port(job.launch.id), agent_config=config,
                dependencies=dependencies, cancel=job.cancel,
                application=monitor_addresses.IMAGE if job.spec.monitored else ''))
        except FogError as error:
            # after a refusal, no machine has to be looked for
            self._asked = not error.refused
            # without an answer a machine may exist: only a search by tags shows it
            self._refused = isinstance(error, (ConfigurationError, PrerequisiteError))
            for failure in error.undo_failures:
                job.launch.undo_failed(job.name, 'undo', failure)
            raise
        job.save(machine_id=machine_id)

    def _tags(self) -> dict[str, str]:
        """Return the tags that change with the launch that uses the machine."""
        spec = self._job.spec
        return {TAG_LAUNCH: self._job.launch.id, TAG_ON_EXIT: spec.on_exit,
                TAG_EXPIRES: str(int(time.time() + spec.lifetime))}

    def _dependencies(self) -> str:
        """Return the hash of the machine's dependencies, by which the provider finds an image."""
        job = self._job
        try:
            under = job.launch.underlay(job.spec.workspaces)
        except PrerequisiteError:
            return ''  # the step that needs ROS 2 raises the same error
        return bootstrap.dependencies(
            job.spec, under, [package for package, _ in job.launch.programs(job.name)])

    def _claim(self, token: str) -> None:
        """Record that this launch has the machine, before the provider creates anything."""
        job = self._job
        pid = os.getpid()
        job.save(
            token=token, created=job.record.created or time.time(), armed=time.time(),
            launch=job.launch.id, last=job.launch.id,
            pid=pid, pid_start=process_start(pid) or 0, boot=boot_id(),
            robot_vpn=job.launch.robot_vpn().interface, monitor=0, monitor_open='')

    def _login_key(self) -> str:
        job = self._job
        path: Path = job.folder.key_file
        process.run(Command((
            'ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', f'fogros2-{job.name}',
            '-f', str(path)), what='make the login key'), timeout=job.timeouts.command)
        return path.with_suffix('.pub').read_text().strip()

    # -- the end --------------------------------------------------------------------------------

    def _end(self) -> None:
        """End the machine by its ``on_exit``; delete the record only after the machine."""
        job = self._job
        mode = job.spec.on_exit
        if job.deleted or job.failed and not job.reused:
            mode = 'delete'
        try:
            with job.step(mode if job.provider.owned else 'let go'):
                if mode == 'delete':
                    for machine_id in self._made():
                        job.provider.destroy(machine_id)
                    job.folder.delete()
                    return
                if mode == 'stop' and job.record.machine_id is not None:
                    job.provider.stop(job.record.machine_id)
                job.save(launch='', pid=0, pid_start=0, robot_vpn=None)
        finally:
            job.launch.choices.end(job.name)

    def _made(self) -> list[str]:
        """Return the machine's id; find the machine of a failed creation by its tags."""
        job = self._job
        if job.record.machine_id is not None:
            return [job.record.machine_id]
        if not self._asked:
            return []
        try:
            return [machine.id for machine in job.provider.find(
                {TAG_NAME: job.name, TAG_LAUNCH: job.launch.id})]
        except Unsupported:
            return []
        except FogError:
            if not self._refused:
                raise
            return []  # the creation was refused before the provider was asked
