# SPDX-License-Identifier: Apache-2.0
"""
Moto's instances, each with a computer behind it: states, addresses, disks and groups follow.

Moto knows what was asked for; what an instance *is* happens here. Its classes are changed in
this process, which serves one box and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import sys
import threading
import time
from typing import Any, Optional

from fogros2.errors import FogError
from fogros2.waiting import wait_until
from rigs.ec2 import computer, guest, metadata, network, told
from rigs.ec2.computer import Boot, Computer

#: Seconds after which an instance that was asked to go down is cut off.
_TIMEOUT = 2.0
#: Share of the boot delay for which an instance is 'pending'.
_PENDING = 0.25
_STATES = {'pending': 0, 'running': 16, 'shutting-down': 32, 'terminated': 48, 'stopping': 64,
           'stopped': 80}
#: Of what made an instance end.
BY_USER = 'Client.UserInitiatedShutdown'
BY_ITSELF = 'Client.InstanceInitiatedShutdown'
BY_SPOT = 'Server.SpotInstanceTermination'
BY_TROUBLE = 'Server.InternalError'


@dataclasses.dataclass
class Machine:
    """
    An instance and its computer.

    :param wanted: run, stop or terminate; ``news`` is set when it changes.
    :param notice: what the metadata service says of an interruption.
    :param asked: when it was told to start (seconds since the epoch); ``ready`` when its SSH
        server answered.
    """

    instance: Any
    computer: Computer
    spot: bool
    disk_of: str
    wanted: str = 'run'
    reason: str = BY_USER
    public: str = ''
    space: str = ''
    host: Optional[network.Host] = None
    notice: str = ''
    runs: bool = False
    again: bool = False
    asked: float = 0.0
    ready: float = 0.0
    news: threading.Event = dataclasses.field(default_factory=threading.Event)
    thread: Optional[threading.Thread] = None
    cutting: Optional[threading.Timer] = None


class Cloud:
    """
    The computers of a box.

    :param mark: the box; on everything that it makes.
    :param boot_delay: seconds from RunInstances until an instance's first process starts.
    :param mounts: folders of this computer that every instance sees, read-only.
    """

    def __init__(
        self, mark: str, net: network.Network, *, boot_delay: float, mounts: tuple[str, ...],
    ) -> None:
        self.mark = mark
        self.net = net
        self.boot_delay = boot_delay
        self.disks = computer.DISKS / mark
        self.addresses = network.Addresses()
        self.machines: dict[str, Machine] = {}
        self._mounts = mounts
        #: Held by who changes an instance's state.
        self.lock = threading.RLock()
        self._closing = threading.Event()

    # -- what callers of the API cause ----------------------------------------------------

    def launch(self, instance: Any, *, spot: bool) -> None:
        """Give a new instance a computer and start it."""
        machine = Machine(
            instance, Computer(self.mark, self.disks / str(instance.id), self._mounts), spot,
            str(instance.image_id))
        with self.lock:
            self.machines[str(instance.id)] = machine
        self._begin(machine)

    def start(self, instance: Any) -> None:
        """Start a stopped instance, with another public address as EC2 gives it."""
        machine = self.machines[str(instance.id)]
        machine.wanted, machine.reason = 'run', BY_USER
        machine.news.clear()
        self._begin(machine)

    def _begin(self, machine: Machine) -> None:
        _set_state(machine.instance, 'pending')
        machine.asked, machine.ready = time.time(), 0.0
        # EC2 tells the address when the instance runs
        nic = machine.instance.nics[0]
        machine.public, nic.public_ip = nic.public_ip or '', None
        machine.thread = threading.Thread(target=self._live, args=(machine,), daemon=True)
        machine.thread.start()

    def end(self, instance: Any, wanted: str, reason: str = BY_USER) -> None:
        """Stop or terminate an instance; what waits for it to be over looks at its state."""
        machine = self.machines[str(instance.id)]
        with self.lock:
            if machine.wanted == 'terminate':
                return
            stopped = _state(instance) == 'stopped'
            machine.wanted, machine.reason = wanted, reason
            machine.again = False
            machine.news.set()
            if stopped and wanted == 'stop':
                return
            _set_state(instance, 'stopping' if wanted == 'stop' else 'shutting-down')
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

    def reboot(self, instance: Any) -> None:
        """Start an instance's computer again."""
        machine = self.machines[str(instance.id)]
        machine.again = True
        self._press(machine)

    def interrupt(self, instance_id: str, *, notice: float, when: str) -> None:
        """Announce that a spot instance is taken away, and take it ``notice`` seconds later."""
        machine = self.machines[instance_id]
        machine.notice = when
        timer = threading.Timer(
            notice, self.end, (machine.instance, 'terminate', BY_SPOT))
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
            print(f'{machine.instance.id}: {error}', file=sys.stderr, flush=True)
            machine.wanted, machine.reason = 'terminate', BY_TROUBLE
        self._finish(machine)

    def _boot(self, machine: Machine) -> bool:
        """Start an instance's computer; False if it isn't wanted any more."""
        instance = machine.instance
        private = str(instance.private_ip)
        if _state(instance) == 'pending':
            if machine.news.wait(self.boot_delay * _PENDING):
                return False
            with self.lock:
                if machine.wanted == 'run':
                    instance.nics[0].public_ip = machine.public or None
                    _set_state(instance, 'running')
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
            link, machine.public or private, private, str(instance.vpc_id))
        self.net.attach(machine.space, machine.host)
        self.protect()
        service = metadata.MetadataService(
            machine.space,
            lambda: told.values(instance, spot=machine.spot, notice=machine.notice),
            lambda: bool(instance.metadata_options.http_tokens == 'required'))
        try:
            plan = told.plan(instance)
            machine.computer.start(Boot(
                f'{network.PREFIX}{self.mark}{link}',
                plan['hostname'] or f"ip-{private.replace('.', '-')}", machine.space, plan))
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
            behaviour = machine.instance.instance_initiated_shutdown_behavior
            with self.lock:
                if machine.wanted == 'run':
                    machine.wanted = 'stop' if behaviour == 'stop' and not machine.spot \
                        else 'terminate'
                    machine.reason = BY_ITSELF
                    _set_state(machine.instance, 'stopping' if machine.wanted == 'stop'
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
        instance = machine.instance
        gone, machine.public = [machine.public], ''
        if machine.wanted == 'terminate':
            computer.remove_disk(machine.computer.disk)
            gone.append(str(instance.private_ip))
        self.addresses.give_back(filter(None, gone))
        # all at once: from this moment on it may be started again
        with self.lock:
            MOTO['terminate' if machine.wanted == 'terminate' else 'stop'](instance)
            text = f'{machine.reason}: {_WORDS[machine.reason]}'
            instance.state_reason.code, instance.state_reason.message = machine.reason, text
            if machine.reason != BY_USER:
                instance._reason = text

    # -- images ---------------------------------------------------------------------------

    def image(self, image: Any, instance: Any, *, reboot: bool) -> None:
        """Copy an instance's disk; the image is pending until that is done."""
        image.state = 'pending'
        threading.Thread(target=self._copy, args=(image, instance, reboot), daemon=True).start()

    def _copy(self, image: Any, instance: Any, reboot: bool) -> None:
        machine = self.machines[str(instance.id)]
        try:
            with machine.computer.still():
                computer.copy_disk(machine.computer.disk, self.disks / str(image.id))
            image.state = 'available'
        except (FogError, OSError) as error:
            print(f'{image.id}: {error}', file=sys.stderr, flush=True)
            image.state = 'failed'
        if reboot and machine.runs:
            self.reboot(instance)

    def forget_image(self, image_id: str) -> None:
        """Remove an image's disk."""
        computer.remove_disk(self.disks / image_id)

    # -- security groups ------------------------------------------------------------------

    def protect(self) -> None:
        """Bring the router's rules in line with the security groups."""
        with self.lock:
            # another thread may take a host away meanwhile: looked at once
            there = [(host, machine.instance) for machine in self.machines.values()
                     if (host := machine.host) is not None]
            members: dict[str, list[str]] = {}
            for host, instance in there:
                for group in instance.nics[0].group_set:
                    members.setdefault(group.id, []).extend((host.public, host.private))
            hosts = [dataclasses.replace(host, allowed=told.allowed(instance, members))
                     for host, instance in there]
            self.net.protect(hosts)

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
                machine.thread.join(10.0)


#: What Moto's own methods do, kept before they are replaced.
MOTO: dict[str, Callable[..., Any]] = {}
_WORDS = {
    BY_USER: 'User initiated shutdown', BY_ITSELF: 'Instance initiated shutdown',
    BY_SPOT: 'Spot instance termination', BY_TROUBLE: 'Internal error on launch',
}


def _state(instance: Any) -> str:
    return str(instance._state.name)


def _set_state(instance: Any, name: str) -> None:
    instance._state.name, instance._state.code = name, _STATES[name]
