# SPDX-License-Identifier: Apache-2.0
"""
The instances of a simulated cloud, each with a computer: states, addresses and disks follow.

An API knows what was asked for; what an instance *is* happens here. A cloud's subclass says what
its instances boot with and who may reach them.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
import dataclasses
import sys
import threading
import time
from typing import Any, Optional, Protocol

from fogros2.errors import FogError
from fogros2.waiting import wait_until
from rigs.computers import computer, guest, network
from rigs.computers.computer import Boot, Computer

#: Seconds after which an instance that was asked to go down is cut off.
_TIMEOUT = 2.0
#: Share of the boot delay for which an instance is 'pending'.
_PENDING = 0.25
#: What made an instance end.
BY_USER, BY_ITSELF, BY_SPOT, BY_TROUBLE = 'user', 'itself', 'spot', 'trouble'


class Service(Protocol):
    """A metadata service."""

    def close(self) -> None:
        """Stop answering."""


@dataclasses.dataclass
class Machine:
    """
    An instance and its computer.

    :param instance: the API's own object.
    :param disk_of: image that its disk is a copy of.
    :param wanted: run, stop or terminate; ``news`` is set when it changes.
    :param notice: when it is interrupted (seconds since the epoch); 0 while nobody knows.
    :param asked: when it was told to start (seconds since the epoch); ``ready`` when its SSH
        server answered.
    """

    id: str
    instance: Any
    computer: Computer
    spot: bool
    disk_of: str
    state: str = 'pending'
    wanted: str = 'run'
    reason: str = BY_USER
    public: str = ''
    private: str = ''
    space: str = ''
    host: Optional[network.Host] = None
    notice: float = 0.0
    runs: bool = False
    again: bool = False
    asked: float = 0.0
    ready: float = 0.0
    news: threading.Event = dataclasses.field(default_factory=threading.Event)
    thread: Optional[threading.Thread] = None
    cutting: Optional[threading.Timer] = None


class Cloud(abc.ABC):
    """
    The computers of a box.

    :param mark: the box; on everything that it makes.
    :param mounts: folders of this computer that every instance sees, read-only.
    :param volumes: instances may mount disks.
    """

    def __init__(
        self, mark: str, net: network.Network, *, mounts: tuple[str, ...], volumes: bool = False,
    ) -> None:
        self.mark = mark
        self.net = net
        #: Seconds from the request until an instance's first process starts.
        self.boot_delay = 0.0
        self.disks = computer.DISKS / mark
        self.addresses = network.Addresses()
        self.machines: dict[str, Machine] = {}
        self._mounts = mounts
        self._volumes = volumes
        #: Held by who changes an instance's state.
        self.lock = threading.RLock()
        self._closing = threading.Event()

    # -- what a cloud fills in ------------------------------------------------------------

    @abc.abstractmethod
    def user_data(self, machine: Machine) -> bytes:
        """Return what an instance was given for its first boot."""

    @abc.abstractmethod
    def plan(self, machine: Machine) -> dict[str, Any]:
        """Return what the first process of an instance has to do; see ``guest``."""

    @abc.abstractmethod
    def network_of(self, machine: Machine) -> str:
        """Return the name of an instance's private network."""

    @abc.abstractmethod
    def allowed(
        self, machine: Machine, members: Mapping[str, Sequence[str]],
    ) -> tuple[network.Allowed, ...]:
        """
        Return what may come in to an instance, in this order.

        :param members: addresses of the instances in each group, by its id.
        """

    def groups_of(self, machine: Machine) -> Sequence[str]:
        """Return the ids of the groups that an instance belongs to."""
        return ()

    @abc.abstractmethod
    def serve_metadata(self, machine: Machine) -> Service:
        """Return an instance's metadata service, which listens in ``machine.space``."""

    @abc.abstractmethod
    def at_shutdown(self, machine: Machine) -> str:
        """Return what follows when an instance shuts itself down: stop or terminate."""

    def changed(self, machine: Machine) -> None:
        """Show an instance's new state to callers of the API; ``lock`` is held."""

    # -- what callers of the API cause ----------------------------------------------------

    def launch(self, number: str, instance: Any, *, spot: bool, disk_of: str) -> None:
        """Give a new instance a computer and start it."""
        machine = Machine(
            number, instance,
            Computer(self.mark, self.disks / number, self._mounts, volumes=self._volumes), spot,
            disk_of)
        with self.lock:
            self.machines[number] = machine
        self._begin(machine)

    def start(self, number: str) -> None:
        """Start a stopped instance, with another public address."""
        machine = self.machines[number]
        machine.wanted, machine.reason = 'run', BY_USER
        machine.news.clear()
        self._begin(machine)

    def _begin(self, machine: Machine) -> None:
        machine.asked, machine.ready = time.time(), 0.0
        self._set(machine, 'pending')
        machine.thread = threading.Thread(target=self._live, args=(machine,), daemon=True)
        machine.thread.start()

    def _set(self, machine: Machine, state: str) -> None:
        with self.lock:
            machine.state = state
            self.changed(machine)

    def end(self, number: str, wanted: str, reason: str = BY_USER) -> None:
        """Stop or terminate an instance; what waits for it to be over looks at its state."""
        machine = self.machines[number]
        with self.lock:
            if machine.wanted == 'terminate':
                return
            stopped = machine.state == 'stopped'
            machine.wanted, machine.reason = wanted, reason
            machine.again = False
            machine.news.set()
            if stopped and wanted == 'stop':
                return
            self._set(machine, 'stopping' if wanted == 'stop' else 'shutting-down')
            runs = machine.runs
        if stopped:
            threading.Thread(target=self._finish, args=(machine,), daemon=True).start()
        elif runs:
            self._press(machine)

    def _press(self, machine: Machine) -> None:
        machine.computer.ask_to_end()
        machine.cutting = threading.Timer(_TIMEOUT, machine.computer.cut)
        machine.cutting.daemon = True
        machine.cutting.start()

    def interrupt(self, number: str, notice: float) -> None:
        """Announce that a spot instance is taken away, and take it ``notice`` seconds later."""
        self.machines[number].notice = time.time() + notice
        timer = threading.Timer(notice, self.end, (number, 'terminate', BY_SPOT))
        timer.daemon = True
        timer.start()

    # -- an instance's life ---------------------------------------------------------------

    def _live(self, machine: Machine) -> None:
        try:
            while self._boot(machine):
                self._went_down(machine)
                if not machine.again or machine.wanted != 'run':
                    break
                machine.again = False
        except (FogError, OSError) as error:
            print(f'{machine.id}: {error}', file=sys.stderr, flush=True)
            machine.wanted, machine.reason = 'terminate', BY_TROUBLE
        self._finish(machine)

    def _boot(self, machine: Machine) -> bool:
        """Start an instance's computer; False if it isn't wanted any more."""
        if machine.state == 'pending':
            if machine.news.wait(self.boot_delay * _PENDING):
                return False
            with self.lock:
                if machine.wanted == 'run':
                    self._set(machine, 'running')
            if machine.news.wait(self.boot_delay * (1 - _PENDING)):
                return False
        if not machine.computer.disk.exists():
            image = self.disks / machine.disk_of
            if image.exists():
                computer.copy_disk(image, machine.computer.disk)
            else:
                computer.new_disk(machine.computer.disk)
        machine.space, link = self.net.add()
        machine.host = network.Host(
            link, machine.public or machine.private, machine.private, self.network_of(machine))
        self.net.attach(machine.space, machine.host)
        self.protect()
        service = self.serve_metadata(machine)
        try:
            plan = self.plan(machine)
            machine.computer.start(Boot(
                f'{network.PREFIX}{self.mark}{link}',
                plan['hostname'] or f"ip-{machine.private.replace('.', '-')}", machine.space,
                plan))
            with self.lock:
                machine.runs = True
                asked = machine.wanted != 'run'
            if asked:
                self._press(machine)
            public = machine.host.public
            wait_until(lambda: machine.computer.ended() or self.net.answers(public, 22),
                       timeout=600.0, longest=0.02, what='its SSH server')
            machine.ready = time.time()
            machine.computer.wait()
        finally:
            machine.runs = False
            service.close()
        return True

    def _went_down(self, machine: Machine) -> None:
        if machine.wanted == 'run' and machine.computer.exit_status() == guest.REBOOT:
            machine.again = True
        if machine.wanted == 'run' and not machine.again:
            with self.lock:
                if machine.wanted == 'run':
                    machine.wanted, machine.reason = self.at_shutdown(machine), BY_ITSELF
                    self._set(machine, 'stopping' if machine.wanted == 'stop'
                              else 'shutting-down')
        self._clear(machine)

    def _clear(self, machine: Machine) -> None:
        """Take away what a computer that is off doesn't have."""
        if machine.cutting is not None:
            machine.cutting.cancel()  # the next boot isn't meant
        machine.computer.remove()
        machine.host = None
        if machine.space:
            self.net.remove(machine.space)
            machine.space = ''
            if not self._closing.is_set():
                self.protect()

    def _finish(self, machine: Machine) -> None:
        """Give an instance's addresses back, and bring it to its last state."""
        self._clear(machine)
        gone, machine.public = [machine.public], ''
        if machine.wanted == 'terminate':
            computer.remove_disk(machine.computer.disk)
            gone.append(machine.private)
        self.addresses.give_back(filter(None, gone))
        # all at once: from this moment on it may be started again
        self._set(machine, 'terminated' if machine.wanted == 'terminate' else 'stopped')

    # -- disks that outlive instances -----------------------------------------------------

    def attach(self, number: str, disk: str, size_gb: int, path: str) -> None:
        """Let an instance that runs have a disk as a block device."""
        if self._volumes and number in self.machines:
            self.machines[number].computer.attach(self.disks / f'{disk}.disk', size_gb, path)

    def detach(self, number: str, disk: str) -> None:
        """Take a disk from an instance."""
        if self._volumes and number in self.machines:
            self.machines[number].computer.detach(self.disks / f'{disk}.disk')

    # -- images ---------------------------------------------------------------------------

    def copy(self, number: str, image: str) -> None:
        """
        Copy an instance's disk to an image.

        :raises FogError: it can't be copied.
        :raises OSError: likewise.
        """
        machine = self.machines[number]
        with machine.computer.still():
            computer.copy_disk(machine.computer.disk, self.disks / image)

    def forget_image(self, image: str) -> None:
        """Remove an image's disk."""
        computer.remove_disk(self.disks / image)

    # -- the firewall ---------------------------------------------------------------------

    def protect(self) -> None:
        """Bring the router's rules in line with the cloud's firewall."""
        with self.lock:
            # another thread may take a host away meanwhile: looked at once
            there = [(host, machine) for machine in self.machines.values()
                     if (host := machine.host) is not None]
            members: dict[str, list[str]] = {}
            for host, machine in there:
                for group in self.groups_of(machine):
                    members.setdefault(group, []).extend((host.public, host.private))
            self.net.protect([
                dataclasses.replace(host, allowed=self.allowed(machine, members))
                for host, machine in there])

    def close(self) -> None:
        """End every computer at once."""
        self._closing.set()
        with self.lock:
            machines = list(self.machines.values())
            for machine in machines:
                machine.wanted = 'terminate'
                machine.news.set()
        for machine in machines:
            machine.computer.cut()
        for machine in machines:
            if machine.thread is not None:
                machine.thread.join(60.0)
