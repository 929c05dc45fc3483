# SPDX-License-Identifier: Apache-2.0
"""Create a machine or reuse a kept one, and wait until it can be reached."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from typing import Any, Literal, Optional
import uuid

from fogros2 import feature, model, plan, process
from fogros2.deploy import robot
from fogros2.deploy.machine_job import Step
from fogros2.deploy.undo import close_ports, end_machine, late
from fogros2.errors import (
    ConfigurationError,
    FogError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    StoreError,
)
from fogros2.host import bootstrap
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
from fogros2.report import Warned
from fogros2.store import is_another_robot, Record, robot_id, this_process

#: Seconds after which the launch tries again to end a machine without which it goes on.
RETRY = 60.0


class Creation(Step):
    """Create or reuse the machine of a deployment, and end it by its ``on_exit``."""

    #: The request to create the machine. ``none``: no machine can exist. ``refused``: before the
    #: provider got it, perhaps. ``unanswered``: a machine may still appear.
    _request: Literal['none', 'sent', 'refused', 'unanswered'] = 'none'

    def run(self) -> None:
        """
        Create or reuse the machine; return when a connection can be tried.

        :raises NameTaken: another launch uses the name, or the kept machine has other options.
        :raises ProviderError: the provider refused, or the machine ended while it started.
        """
        context, job = self._context, self._job
        with job.step('machine') as detail:
            kept = self._kept()
            if kept is not None:
                kept = self._adopt(kept)
                detail.append('kept from before')
            else:
                self._create()
            context.choices.begin(job.name)
            machine = context.provider.reachable(
                job.machine_id, name=job.name, timeout=context.timeouts.boot, known=kept)
            price = machine.cost_per_hour
            if price is None:
                price = context.choices.price(job.spec)
            context.choices.expect(job.spec, price)
            job.limit(made=True)
            if price:
                detail.append(plan.price(price))
            job.save(endpoint=machine.endpoint, spec=job.spec)
            detail.append(machine.endpoint.host if machine.endpoint else machine.id[:20])
            if machine.note:
                detail.append(machine.note)
            job.machine = machine

    # -- a kept machine -------------------------------------------------------------------------

    def _kept(self) -> Optional[Machine]:
        """Return the machine of this name that an earlier launch kept or stopped, or None."""
        context, job = self._context, self._job
        if not context.store.exists(job.name):
            return None  # ``create`` finds and refuses a machine without a record
        before = context.store.load(job.name)
        if is_another_robot(before.robot):
            raise NameTaken(
                f"the machine '{job.name}' belongs to the robot {before.robot}: the state folder "
                'is a copy, or this computer has another network card',
                f'give the machine another name=, or: ros2 fog delete --force {job.name}')
        own = before.launch == context.launch_id
        if before.launch_alive and not own:
            raise NameTaken(
                f"the launch with process {before.pid} has the machine '{job.name}'",
                'give the machine another name=, or end that launch')
        other, provider = before.provider != job.spec.provider, self._provider(before)
        machine: Optional[Machine] = None
        # a launch that was killed did not save the id of its machine, if it has one
        if before.machine_id is not None:
            with contextlib.suppress(MachineNotFound):
                machine = context.choices.running.pop(before.machine_id, None) \
                    or provider.describe(before.machine_id)
        if machine is None or machine.state is MachineState.DELETED or (
                own and before.spec.on_exit == 'delete'):
            # what was made for it may still be there
            if not end_machine(provider, before):
                context.store.set_aside(before)
            return None
        if other:
            raise NameTaken(
                f"'{job.name}' is a machine of the provider '{before.provider}'",
                f'give the machine another name=, or: ros2 fog delete {job.name}')
        self._check_alike(before.asked, machine)
        # the earlier choices still hold; everything else comes from this launch
        job.spec = dataclasses.replace(job.spec, options=before.spec.options)
        context.choices.expect(job.spec, context.choices.price(job.spec))
        job.limit(made=True)
        job.record = dataclasses.replace(before, spec=job.spec)
        job.formers = before.owners or (before.last,)
        return machine

    def _provider(self, record: Record) -> Provider:
        return self._context.provider if record.provider == self._job.spec.provider \
            else robot.provider(record.provider)

    def _check_alike(self, before: Any, machine: Machine) -> None:
        """Raise if the kept machine was created with other options than this launch asks for."""
        job = self._job
        then, now = (json.loads(model.to_json(o)) for o in (before, job.spec.options))
        other = sorted(key for key in {*then, *now} if then.get(key) != now.get(key))
        if other:
            raise NameTaken(
                f"the machine '{job.name}' of an earlier launch has another {', '.join(other)}",
                f'give the machine another name=, or: ros2 fog delete {job.name}')
        if job.spec.on_exit == 'stop' and not self._context.capabilities.adopt \
                and machine.tags.get(TAG_ON_EXIT, 'stop') != 'stop':
            raise ConfigurationError(
                f"the machine '{job.name}' was not made to be stopped and started",
                f"keep it with on_exit='keep', or: ros2 fog delete {job.name}")

    def _adopt(self, machine: Machine) -> Optional[Machine]:
        """Use a kept machine; return it unless it has to start first."""
        context, job = self._context, self._job
        job.enter('kept')
        self._request = 'sent'
        job.machine = machine
        self._claim(job.record.token)
        context.provider.adopt(machine.id, job.spec, self._tags())
        if job.record.made:
            # by a launch that was killed
            job.save(made=close_ports(job))
        if machine.state in (MachineState.STOPPED, MachineState.STOPPING):
            context.provider.start(machine.id)
            return None
        return machine

    # -- a new machine --------------------------------------------------------------------------

    def _create(self) -> None:
        context, job = self._context, self._job
        job.spec = context.choices.resolved(job.spec)
        context.choices.expect(job.spec, context.choices.price(job.spec))
        job.limit()
        self._end_requests()
        token = str(uuid.uuid4())
        context.store.delete(job.name)
        job.record = dataclasses.replace(
            job.record, spec=job.spec, vpn_port=plan.machine_port(context.launch_id))
        self._claim(token)
        config = {
            **plan.agent_config(job.spec, context.launch_id, job.directory, ()),
            'boot_timeout': context.timeouts.boot + context.timeouts.ssh,
        } if context.capabilities.agent_directory else {}
        tags = {TAG_NAME: job.name, TAG_ROBOT: robot_id(), **self._tags()}
        can = context.capabilities
        key = self._login_key() if can.owned and can.shell_kind == 'ssh' else ''
        request = CreateRequest(
            token=token, authorized_key=key, tags=tags,
            dependencies=tags.get(TAG_DEPENDENCIES, ''),
            vpn_port=job.record.vpn_port, agent_config=config)
        for each, own in feature.used(job.spec):
            request = each.request(request, own)
        self._request = 'sent'
        try:
            machine_id = context.provider.create(job.spec, request)
        except FogError as error:
            if error.refused is not None:
                self._request = 'none' if error.refused else 'unanswered'
            elif isinstance(error, (ConfigurationError, PrerequisiteError)):
                self._request = 'refused'
            for failure in error.undo_failures:
                job.undo.failed('undo', failure)
            raise
        job.save(machine_id=machine_id)

    def _end_requests(self) -> None:
        """Delete what the launch requested before under this name, if it appeared meanwhile."""
        context = self._context
        for record, age in context.store.requests():
            if (record.name, record.last) == (self._job.name, context.launch_id):
                with contextlib.suppress(FogError):  # `ros2 fog gc` tries again
                    if end_machine(self._provider(record), record, age):
                        context.store.answered(record)

    def _tags(self) -> dict[str, str]:
        """Return the tags that change with the launch that uses the machine."""
        spec, dependencies = self._job.spec, self._dependencies()
        return {TAG_LAUNCH: self._context.launch_id, TAG_ON_EXIT: spec.on_exit,
                TAG_EXPIRES: str(int(time.time() + spec.lifetime)),
                **({TAG_DEPENDENCIES: dependencies} if dependencies else {})}

    def _dependencies(self) -> str:
        """Return the hash of the machine's dependencies, by which the provider finds an image."""
        context, job = self._context, self._job
        try:
            under = context.underlay(job.spec.workspaces)
        except PrerequisiteError:
            return ''  # the step that needs ROS 2 raises the same error
        return bootstrap.dependencies(job.spec, under, context.packages)

    def _claim(self, token: str) -> None:
        """Record that this launch has the machine, and ends it."""
        context, job = self._context, self._job
        job.undoing('end', self._end)
        job.claimed = time.monotonic()
        job.save(
            token=token, created=job.record.created or time.time(), armed=time.time(),
            launch=context.launch_id, last=context.launch_id, owners=job.formers,
            robot=robot_id(), **this_process(), robot_vpn=context.vpn.interface, carried='',
            notes={})

    def _login_key(self) -> str:
        context, job = self._context, self._job
        path = context.store.key_file(job.name)
        process.run(Command((
            'ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', f'fogros2-{job.name}',
            '-f', str(path)), what='make the login key'), timeout=context.timeouts.command)
        return path.with_suffix('.pub').read_text().strip()

    # -- the end --------------------------------------------------------------------------------

    def _end(self) -> None:
        """End the machine by its ``on_exit``; one that is given up is tried again."""
        context, job = self._context, self._job
        while True:
            last = job.life.phase != 'ended' or context.cancel.is_set()
            try:
                self._try_to_end()
                job.has_ended = True
                return
            except FogError as error:
                if last:
                    raise
                context.report(Warned(
                    job.name, f"'{job.name}' has not ended yet: {error.args[0]}",
                    error.hint or f'the launch tries again every {RETRY:g} s'))
            context.cancel.wait(RETRY)

    def _try_to_end(self) -> None:
        """End the machine; delete the record only after the machine."""
        context, job = self._context, self._job
        mode = job.life.ending(job.spec.on_exit)
        with job.step(mode if context.capabilities.owned else 'let go'):
            if mode == 'delete':
                self._delete()
            else:
                if mode == 'stop' and job.record.machine_id is not None:
                    context.provider.stop(job.record.machine_id)
                job.save(launch='', pid=0, pid_start=0, robot_vpn=None, notes={})
        if mode != 'keep':
            context.choices.end(job.name)

    def _delete(self) -> None:
        """Delete the machine and its record."""
        context, job = self._context, self._job
        if self._request != 'none':
            try:
                settled = end_machine(context.provider, job.record, tidy=False)
            except FogError:
                if self._request != 'refused':
                    with contextlib.suppress(StoreError):
                        # a kept one has to be deleted later, too
                        job.save(spec=dataclasses.replace(job.spec, on_exit='delete'))
                    raise
                settled = True
            if self._request == 'unanswered' and not settled:
                context.store.set_aside(job.record)
                raise late(job.record)
        context.store.delete(job.name)
