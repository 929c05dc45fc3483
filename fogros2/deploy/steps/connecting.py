# SPDX-License-Identifier: Apache-2.0
"""
Log in to a machine: by SSH from outside at first, through the VPN later.

Some providers hand over the machine's host key at boot, where another program may have read it.
The machine then generates a new host key over the first connection, and the robot pins that key.
"""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
import threading
import time
from typing import Optional

from fogros2 import shell as shells
from fogros2.deploy.context import Context
from fogros2.deploy.machine_job import MachineJob, Step
from fogros2.deploy.undo import SSH_PORT
from fogros2.errors import (
    Cancelled,
    ConnectError,
    DeadlineExceeded,
    FogError,
    HostKeyError,
    MachineNotFound,
    ProviderError,
)
from fogros2.model import Command, Endpoint, MachineState
from fogros2.shell import host_key, Shell
from fogros2.shell.movable import MovableShell
from fogros2.store import Made
from fogros2.waiting import wait_until

#: Time-out of one login attempt in seconds: a cancel takes effect only at its end. An existing
#: computer, which does not boot, gets no more time than this.
LOGIN_TIMEOUT = 10.0
#: Login time-out in another robot's VPN: WireGuard repeats a lost handshake after 5 s.
VPN_TIMEOUT = 30.0
#: Seconds between two checks of the machine's state and of the robot's public address.
POLL_INTERVAL = 10.0
#: Errors of a machine that is still booting.
_TRANSIENT: tuple[type[FogError], ...] = (ConnectError, DeadlineExceeded)


class Connection(Step):
    """The robot's login to one machine."""

    #: The source address to which the SSH port is open.
    _allowed = ''
    _checked = 0.0
    _shell: MovableShell
    #: Whether the shell is in the VPN, and whether it has to stay outside from now on.
    _inside = _leaving = False

    def __init__(self, context: Context, job: MachineJob) -> None:
        super().__init__(context, job)
        #: Guards the record's note of the SSH port with the rules of the firewall.
        self._entering = threading.Lock()

    def open(self) -> None:
        """
        Log in to the machine with a pinned host key that only the machine has.

        :raises ShellError: the machine refuses the login.
        """
        context, job, endpoint = self._context, self._job, self._job.machine.endpoint
        assert endpoint is not None
        with job.step('connect') as detail:
            if context.capabilities.owned:
                endpoint = dataclasses.replace(
                    endpoint, key_file=str(context.store.key_file(job.name)),
                    host_key=job.record.host_key or endpoint.host_key)
            job.save(endpoint=endpoint)
            if context.capabilities.firewall:
                job.push(SSH_PORT, endpoint.port)
                job.undo.callback(self._leave)
                if job.life.phase == 'kept':
                    # the earlier launch closed the port, or the robot's address has changed
                    self._open_port()
            job.shell = self._shell = MovableShell(self._shell_to(endpoint))
            job.probes.append(lambda seconds: job.shell.run(
                Command(('true',), what='reach it'), timeout=seconds, check=False))
            job.undo.callback(self._shell.close)
            self._log_in(self._shell)
            if context.capabilities.one_time_host_key and not job.record.host_key:
                self._renew_host_key(endpoint)
                detail.append('with a host key of its own')

    def enter_vpn(self) -> None:
        """
        Move SSH into the VPN, and close the SSH port to the outside.

        Does nothing where the provider has no firewall. SSH that carries the VPN stays outside.
        """
        job = self._job
        if not self._context.capabilities.firewall:
            return
        job.undoing(SSH_PORT, self._leave_vpn)
        if not job.record.carried:
            with job.step('firewall') as detail:
                self._enter()
                others = ', '.join(self._context.provider.ssh_networks(job.spec))
                detail.append(f'SSH through the VPN, and open to {others}' if others else
                              f'SSH through the VPN alone, port {self._outside.port} closed')

    def open_outside(self) -> Endpoint:
        """
        Open the SSH port to the robot; return how a shell reaches the machine by it.

        :raises Cancelled: the launch leaves the machine.
        """
        if self._context.capabilities.firewall:
            with self._entering:
                if self._leaving:
                    raise Cancelled('opening the SSH port')
                self._open_port()
        return self._outside

    def close_outside(self) -> None:
        """Move SSH of a machine that is up into the VPN again, if its SSH port is open."""
        job = self._job
        if job.life.begun and Made(SSH_PORT, self._outside.port) in job.record.made:
            self._enter()

    def _enter(self) -> None:
        inside = None
        if not self._inside:
            inside = self._shell_to(
                dataclasses.replace(self._outside, host=self._job.interface.address))
            try:
                self._log_in(inside)
            except BaseException:
                inside.close()
                raise
        with self._entering:
            if self._leaving:
                if inside is not None:
                    inside.close()
                return
            if inside is not None:
                self._shell.move(inside)
                self._inside = True
            self._allow([])
            self._job.forget(Made(SSH_PORT, self._outside.port))

    def _leave(self) -> None:
        """Let no feature open the port or move the shell from now on."""
        with self._entering:
            self._leaving = True

    def _leave_vpn(self) -> None:
        """Reach a kept machine from outside again, before the VPN is taken down."""
        self._leave()
        if self._inside and self._job.survives():
            self._open_port()
            self._shell.move(self._shell_to(self._outside))

    @property
    def _outside(self) -> Endpoint:
        """How a shell reaches the machine without the VPN."""
        outside = self._job.record.endpoint
        assert outside is not None
        return outside

    def _open_port(self) -> None:
        """Record that the SSH port is open, and open it to the robot's public address."""
        self._job.makes(SSH_PORT, self._outside.port)
        address = self._context.provider.robot_address()
        self._allow([address])
        self._allowed = address

    def _allow(self, sources: Sequence[str]) -> None:
        provider = self._context.provider
        provider.allow(self._job.machine_id, self._outside.port,
                       [*sources, *provider.ssh_networks(self._job.spec)])

    def _shell_to(self, endpoint: Endpoint) -> Shell:
        return shells.connect(
            endpoint, name=self._job.name, timeout=self._context.timeouts.ssh)

    def _log_in(
        self, shell: Shell, transient: tuple[type[FogError], ...] = _TRANSIENT,
    ) -> None:
        """
        Retry the login until it succeeds; after the time-out, raise the last error.

        :param transient: errors that are retried.
        """
        job, ssh = self._job, self._context.timeouts.ssh
        last: Optional[FogError] = None
        self._checked = time.monotonic()

        def probe() -> bool:
            nonlocal last
            try:
                shell.run(Command(('true',), what='connect'), cancel=job.cancel,
                          timeout=min(LOGIN_TIMEOUT, ssh))
                return True
            except transient as error:
                last = error
                self._check()
                return False

        try:
            wait_until(probe, timeout=self._timeout(), cancel=job.cancel, longest=0.5,
                       what=f"'{job.name}' to let us in")
        except DeadlineExceeded as error:
            raise last or error from error

    def _timeout(self) -> float:
        """Return the login time-out in seconds; a machine that may still boot gets more."""
        timeouts, provider, record = self._context.timeouts, self._context.provider, \
            self._job.record
        if self._context.other_vpn is not None:
            return min(timeouts.ssh, VPN_TIMEOUT)
        if not provider.capabilities.owned or self._job.life.begun:
            # the login to a machine that is up delays the next choice of its VPN's path
            return min(timeouts.ssh, LOGIN_TIMEOUT)
        boots = provider.capabilities.one_time_host_key and not record.host_key
        remaining = timeouts.boot - (time.monotonic() - self._job.claimed) if boots else 0.0
        return max(timeouts.ssh, remaining)

    def _check(self) -> None:
        """
        Check now and then that the machine runs, and that the firewall admits the robot.

        :raises ProviderError: the machine has ended.
        """
        provider, job = self._context.provider, self._job
        if not provider.capabilities.firewall or time.monotonic() - self._checked < POLL_INTERVAL:
            return
        self._checked = time.monotonic()
        try:
            state = provider.describe(job.machine_id).state
        except MachineNotFound:
            state = MachineState.DELETED
        except FogError:
            return
        if state not in (MachineState.PENDING, MachineState.RUNNING):
            raise ProviderError(f"'{job.name}' ended while it was coming up",
                                "the provider's own log says why")
        # a failed look-up is retried at the next check; the login's error is reported in the end
        with contextlib.suppress(FogError):
            if provider.robot_address() != self._allowed:
                self.open_outside()

    def _renew_host_key(self, endpoint: Endpoint) -> None:
        job = self._job
        key = host_key.parse(job.run(host_key.renew()))
        endpoint = dataclasses.replace(endpoint, host_key=key)
        job.save(endpoint=endpoint, host_key=key)
        self._context.provider.pin(job.machine_id, key)
        self._shell.move(self._shell_to(endpoint))
        # the SSH server may need a moment to load the new key
        self._log_in(self._shell, transient=(*_TRANSIENT, HostKeyError))
