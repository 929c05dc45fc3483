# SPDX-License-Identifier: Apache-2.0
"""
How a launch gets into a machine: with SSH from outside at first, through the VPN from then on.

Where the provider handed the machine's host key over at boot, somebody else may have read it: over
the first connection the machine makes another, which is the pinned one from then on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from typing import Optional

from fogros2 import shell as shells
from fogros2.deploy.job import Job
from fogros2.errors import (
    ConnectError,
    DeadlineExceeded,
    FogError,
    HostKeyError,
    MachineNotFound,
    ProviderError,
)
from fogros2.model import Command, Endpoint, Machine, MachineState, VpnInterface
from fogros2.shell import host_key, Shell
from fogros2.shell.movable import MovableShell
from fogros2.waiting import wait_until

#: Seconds one attempt to log in may take: a cancel isn't seen before its end. A computer that
#: exists already has answered once, and gets no more than this.
LOGIN_ATTEMPT = 10.0
#: Seconds between two looks at the robot's public address, and the machine, while it waits.
ADDRESS_INTERVAL = 10.0
#: What a machine that still boots answers.
_TRANSIENT: tuple[type[FogError], ...] = (ConnectError, DeadlineExceeded)


class Entrance:
    """The way into one machine."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._shell: Optional[MovableShell] = None
        self._allowed = ''
        self._looked = 0.0

    def connect(self, machine: Machine) -> Shell:
        """
        Return a shell on the machine, logged in, with a host key that nobody else has.

        :raises ShellError: it doesn't let us in.
        """
        job = self._job
        assert machine.shell is not None
        with job.step('connect') as detail:
            endpoint = machine.shell
            if job.provider.owned:
                endpoint = dataclasses.replace(
                    endpoint, key_file=str(job.folder.key_file),
                    host_key=job.record.host_key or endpoint.host_key)
            job.save(shell=endpoint)
            if job.provider.firewall:
                job.undoing('firewall', self._close)
                if job.reused:
                    # the launch before closed it; or the robot has another address by now
                    self._open()
            shell = self._shell = MovableShell(self._shell_to(endpoint))
            job.shell = shell
            job.undo.callback(shell.close)
            self._log_in(shell)
            if job.provider.one_time_host_key and not job.record.host_key:
                self._renew_host_key(shell, endpoint)
                detail.append('with a host key of its own')
            return shell

    def go_inside(self, interface: VpnInterface) -> None:
        """
        Reach the machine through the VPN, which carries by now, and close the way from outside.

        Where the provider has no firewall everything stays as it is.
        """
        job, shell, outside = self._job, self._shell, self._job.record.shell
        if not job.provider.firewall or shell is None or outside is None:
            return
        with job.step('firewall') as detail:
            inside = self._shell_to(dataclasses.replace(outside, host=interface.address))
            try:
                self._log_in(inside)
            except BaseException:
                inside.close()
                raise
            job.undoing('firewall', self._go_outside)
            shell.move(inside)
            job.provider.allow(job.machine_id, outside.port, [])
            detail.append(f'SSH through the VPN alone, port {outside.port} closed')

    def _go_outside(self) -> None:
        """Reach a machine that is kept without the VPN, which is about to be taken down."""
        job, shell, outside = self._job, self._shell, self._job.record.shell
        if job.survives and shell is not None and outside is not None:
            self._open()
            shell.move(self._shell_to(outside))

    def _close(self) -> None:
        job = self._job
        if job.survives and job.record.shell is not None:
            job.provider.allow(job.machine_id, job.record.shell.port, [])

    def _open(self) -> None:
        """Let this robot in from where it is now."""
        job = self._job
        assert job.record.shell is not None
        address = job.provider.robot_address()
        job.provider.allow(job.machine_id, job.record.shell.port, [address])
        self._allowed = address

    def _shell_to(self, endpoint: Endpoint) -> Shell:
        return shells.connect(endpoint, name=self._job.name, timeout=self._job.timeouts.ssh)

    def _log_in(
        self, shell: Shell, transient: tuple[type[FogError], ...] = _TRANSIENT,
    ) -> None:
        """
        Wait until the machine lets us in; else say what it answered last.

        :param transient: errors that may pass.
        """
        job = self._job
        last: Optional[FogError] = None
        self._looked = time.monotonic()

        def probe() -> bool:
            nonlocal last
            try:
                shell.run(Command(('true',), what='connect'), cancel=job.cancel,
                          timeout=min(LOGIN_ATTEMPT, job.timeouts.ssh))
                return True
            except transient as error:
                last = error
                self._look_around()
                return False

        try:
            wait_until(probe, timeout=self._patience(), cancel=job.cancel, longest=0.5,
                       what=f"'{job.name}' to let us in")
        except DeadlineExceeded as error:
            raise last or error from error

    def _patience(self) -> float:
        """Return how long (s) logging in may take; one that runs may have to boot yet."""
        job = self._job
        if not job.provider.owned:
            return min(job.timeouts.ssh, LOGIN_ATTEMPT)
        boots = job.provider.one_time_host_key and not job.record.host_key
        left = job.timeouts.boot - (time.time() - job.record.armed) if boots else 0.0
        return max(job.timeouts.ssh, left)

    def _look_around(self) -> None:
        """
        Look now and then whether the machine is there, and the robot where it was let in from.

        :raises ProviderError: the machine has ended.
        """
        job = self._job
        if not job.provider.firewall or time.monotonic() - self._looked < ADDRESS_INTERVAL:
            return
        self._looked = time.monotonic()
        try:
            state = job.provider.describe(job.machine_id).state
        except MachineNotFound:
            state = MachineState.DELETED
        except FogError:
            return
        if state not in (MachineState.PENDING, MachineState.RUNNING):
            raise ProviderError(f"'{job.name}' ended while it was coming up",
                                "the provider's own log says why")
        # who can't be asked now is asked again; the login says what is wrong in the end
        with contextlib.suppress(FogError):
            if job.provider.robot_address() != self._allowed:
                self._open()

    def _renew_host_key(self, shell: MovableShell, endpoint: Endpoint) -> None:
        job = self._job
        key = host_key.parse(job.on(shell, [host_key.renew()]))
        endpoint = dataclasses.replace(endpoint, host_key=key)
        job.save(shell=endpoint, host_key=key)
        job.provider.pin(job.machine_id, key)
        shell.move(self._shell_to(endpoint))
        # its SSH server may take a moment to read the new one
        self._log_in(shell, transient=(*_TRANSIENT, HostKeyError))
