# SPDX-License-Identifier: Apache-2.0
"""
Log in to a machine: by SSH from outside at first, through the VPN later.

Some providers hand over the machine's host key at boot, where another program may have read it.
The machine then generates a new host key over the first connection, and the robot pins that key.
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

#: Time-out of one login attempt in seconds: a cancel takes effect only at its end. An existing
#: computer, which does not boot, gets no more time than this.
LOGIN_ATTEMPT = 10.0
#: Seconds between two checks of the machine's state and of the robot's public address.
ADDRESS_INTERVAL = 10.0
#: Errors of a machine that is still booting.
_TRANSIENT: tuple[type[FogError], ...] = (ConnectError, DeadlineExceeded)


class Entrance:
    """The robot's login to one machine."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._shell: Optional[MovableShell] = None
        self._allowed = ''
        self._looked = 0.0

    def connect(self, machine: Machine) -> Shell:
        """
        Log in to the machine; return a shell whose pinned host key only the machine has.

        :raises ShellError: the machine refuses the login.
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
                    # the earlier launch closed the port, or the robot's address has changed
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
        Move SSH into the VPN, and close the SSH port to the outside.

        Does nothing where the provider has no firewall.
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
        """Reach a kept machine from outside again, before the VPN is taken down."""
        job, shell, outside = self._job, self._shell, self._job.record.shell
        if job.survives and shell is not None and outside is not None:
            self._open()
            shell.move(self._shell_to(outside))

    def _close(self) -> None:
        job = self._job
        if job.survives and job.record.shell is not None:
            job.provider.allow(job.machine_id, job.record.shell.port, [])

    def _open(self) -> None:
        """Open the SSH port to the robot's current public address."""
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
        Retry the login until it succeeds; after the time-out, raise the last error.

        :param transient: errors that are retried.
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
        """Return the login time-out in seconds; a machine that may still boot gets more."""
        job = self._job
        if not job.provider.owned:
            return min(job.timeouts.ssh, LOGIN_ATTEMPT)
        boots = job.provider.one_time_host_key and not job.record.host_key
        left = job.timeouts.boot - (time.time() - job.record.armed) if boots else 0.0
        return max(job.timeouts.ssh, left)

    def _look_around(self) -> None:
        """
        Check now and then that the machine runs, and that the firewall admits the robot.

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
        # a failed look-up is retried at the next check; the login's error is reported in the end
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
        # the SSH server may need a moment to load the new key
        self._log_in(shell, transient=(*_TRANSIENT, HostKeyError))
