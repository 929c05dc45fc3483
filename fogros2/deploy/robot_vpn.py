# SPDX-License-Identifier: Apache-2.0
"""The robot's VPN interface, one for each launch, and the machines that it connects."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
import os
from pathlib import Path
import threading
import time
from typing import Optional

from fogros2 import plan, process
from fogros2.deploy.robot import run
from fogros2.errors import Cancelled, CommandError, ConfigurationError, FogError, VpnError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.report import Event, Reporter, step, StepFailed
from fogros2.vpn import addresses, helped, owner, Vpn
from fogros2.waiting import Periodic

#: Seconds between two refreshes of sudo's ticket, which is valid for some minutes, and between
#: two looks at the packet filter, which need root.
TICKET_REFRESH = 120.0
#: Seconds that a new machine waits for the others to add it as a peer.
UPDATE_TIMEOUT = 5.0
#: Interval in seconds of the health check, and the longest one between attempts to repair.
POLL_INTERVAL, LONGEST_POLL_INTERVAL = 1.0, 15.0


def choose_interface(
    launch_id: str, folder: Path, environment: Mapping[str, str], timeout: float,
    others: Iterable[str],
) -> VpnInterface:
    """
    Return an interface with a subnet and a port that this computer does not use.

    :param folder: the launch's folder.
    :param others: networks of other VPNs that the launch joins later.
    :raises FogError: there is none, or this computer's networks cannot be read.
    """
    used = addresses.parse_used(run([addresses.used_networks()], timeout=timeout))
    network = addresses.choose_subnet(
        [*used, *others], launch_id=launch_id, pool=addresses.pool_from(environment))
    interface = plan.robot_interface(
        launch_id, network, addresses.choose_port(environment), str(folder / 'vpn.key'),
        os.getpid())
    if helped.permitted():
        return dataclasses.replace(interface, key_file=helped.key_file(interface.name))
    return interface


class RobotVpn:
    """
    The robot's VPN interface, one for each launch, and the machines that it connects.

    :param timeout: of the commands for the interface, in seconds.
    :param cancel: set when the launch is cancelled.
    :param ending: set when the launch is on its way down.
    :param choose_port: returns the user's UDP port, or one that is free now.
    """

    def __init__(
        self, interface: VpnInterface, vpn: Vpn, *, report: Reporter, timeout: float,
        cancel: threading.Event, ending: threading.Event, choose_port: Callable[[], int],
    ) -> None:
        self.interface = interface
        self.vpn = vpn
        self.report = report
        #: Whether a part of the interface may exist on this computer.
        self._made = False
        self._timeout = timeout
        self._cancel = cancel
        self._ending = ending
        self._choose_port = choose_port
        self._lock = threading.Lock()
        self._members: dict[str, VpnMember] = {}
        #: Where the machines are, by name; see ``HostFacts.network``.
        self._places: dict[str, str] = {}
        #: The robot as the machines' peer while the interface is up.
        self._peer: Optional[Peer] = None
        self._stop = threading.Event()
        self._poll_interval = POLL_INTERVAL
        #: Why the last health check or repair failed, '' if it did not.
        self._failure = ''
        #: Whether the helper makes the interface.
        self.helped = helped.made(interface)
        # the helper needs no ticket; container machines then refresh one that is there
        self._ticket = not self.helped or process.sudo_trouble() is None
        self._ticket_valid = True
        self._ticket_refreshed = time.monotonic()

    def ensure(self) -> Peer:
        """
        Bring the interface up if it is down; return the robot as the machines' peer.

        :raises Cancelled: the launch has taken the interface down.
        """
        with self._lock:
            if self._peer is None:
                if self._stop.is_set():
                    # a thread that still updates a machine's peers may come late; nothing would
                    # take the interface down a second time
                    raise Cancelled('the VPN interface')
                with step(self.report, '', 'VPN interface') as detail:
                    self._made = True
                    public_key = self._run([self.vpn.keys(self.interface)]).strip()
                    self._bring_up()
                    detail.append(f'{self.interface.name} {self.interface.address}')
                self._peer = Peer('robot', public_key, self.interface.address)
                Periodic('fog-vpn', POLL_INTERVAL, self.check_health, stop=self._stop)
            return self._peer

    def use(self, vpn: Vpn) -> None:
        """Use commands with another filter; bring an interface that is up to that state."""
        with self._lock:
            self.vpn = vpn
            if self._peer is not None:
                self._run(vpn.up(self.interface, self._peers()))

    def _run(self, commands: Iterable[Command], *, cancel: bool = True) -> str:
        return run(commands, timeout=self._timeout, cancel=self._cancel if cancel else None)

    def _bring_up(self) -> None:
        """Bring the interface up, with another port if a program takes the free one first."""
        for last in (False, False, True):
            try:
                report_unfiltered(self.report, '', self._run(self.vpn.up(self.interface, [])))
                break
            except CommandError as error:
                if 'Address already in use' not in error.result.stderr:
                    raise
                port = self._choose_port()
                if last or port == self.interface.port:
                    raise VpnError(
                        f'UDP port {self.interface.port} of this computer is in use already',
                        f'ss -lunp shows by whom; {addresses.PORT_VARIABLE} names another, and '
                        'without it each launch takes a free one') from error
                self.interface = dataclasses.replace(self.interface, port=port)
        self._note_owner()

    def _note_owner(self) -> None:
        """Let gc recognise the interface; the helper knows whose its interfaces are."""
        if not self.helped:
            process.run(owner.note(self.interface), timeout=self._timeout, check=False)

    def place(self, name: str, network: str) -> None:
        """
        Note the network that a machine has outside the VPN.

        :param network: see ``HostFacts.network``.
        :raises ConfigurationError: another machine of the launch has it. Two interfaces with the
            launch's subnet and port can't be in one network.
        """
        with self._lock:
            for other, known in self._places.items():
                if network and other != name and known == network:
                    raise ConfigurationError(
                        f"'{name}' and '{other}' are one computer",
                        'use one machine for both, or a ContainerInstance there for one of them')
            self._places[name] = network

    def peers_of(self, member: VpnMember) -> list[Peer]:
        """Return the current peers of a machine."""
        robot = self.ensure()
        with self._lock:
            others = [other.route for name, other in sorted(self._members.items())
                      if name != member.name]
        own = member.route
        if member.relay:  # which the machine knows from its packets
            own = dataclasses.replace(own, robot_endpoint=None)
        return plan.machine_peers(robot, own, others)

    def admit(self, member: VpnMember) -> None:
        """Add a machine to the robot's peers."""
        with self._lock:
            self._members[member.name] = member
            self._run(self.vpn.peers(self.interface, self._peers()))

    def dial(self, member: VpnMember, relay: str, *, anew: bool) -> None:
        """
        Send the packets for a machine to a relay; see :class:`fogros2.feature.VpnLink`.

        :param anew: end a handshake that has begun: it would be repeated only after 5 s.
        """
        with self._lock:
            if self._members.get(member.name) is not member or self._stop.is_set():
                return
            member.relay = relay
            if anew:
                self._run(self.vpn.peers(self.interface, [
                    peer for peer in self._peers() if peer.name != member.name]), cancel=False)
            self._run(self.vpn.peers(self.interface, self._peers()), cancel=False)

    def spread(self, new: VpnMember) -> None:
        """
        Add a new machine to the peers of the other machines.

        A machine that cannot be updated now is retried in the background.
        """
        new.update(self)
        with self._lock:
            others = [member for member in self._members.values() if member is not new]
        threads = [threading.Thread(target=self._update, args=(other,), name='fog-peers',
                                    daemon=True) for other in others]
        for thread in threads:
            thread.start()
        until = time.monotonic() + UPDATE_TIMEOUT
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _update(self, member: VpnMember) -> None:
        """Update a machine's peers; retry until that succeeds."""
        pause = 1.0
        while not self._ending.is_set() and self._members.get(member.name) is member:
            try:
                member.update(self)
                return
            except FogError as error:
                if pause == 1.0 and not self._ending.is_set():
                    self.report(StepFailed(
                        member.name, 'VPN peers', 0.0,
                        f'does not know a new machine yet, trying again: {error}', fatal=False))
            self._stop.wait(pause)
            pause = min(2 * pause, 5.0)

    def remove(self, name: str) -> None:
        """Remove a machine from the robot's peers, unless the whole launch is ending."""
        with self._lock:
            self._places.pop(name, None)
            member = self._members.pop(name, None)
            if member is not None and self._peer is not None and not self._ending.is_set():
                self._run(self.vpn.peers(self.interface, self._peers()), cancel=False)

    def _peers(self) -> list[Peer]:
        return [self._members[name].dialled for name in sorted(self._members)]

    def check_health(self) -> float:
        """
        Repair the interface if its program has ended or its filter is gone; nodes do not notice.

        Return the seconds until the next check; a lasting failure is reported once.
        """
        checks = [self.vpn.health_check(self.interface)]
        if time.monotonic() - self._ticket_refreshed > TICKET_REFRESH:
            self._ticket_refreshed = time.monotonic()
            if self._ticket:
                self._refresh_ticket()
            if self.helped or self._ticket_valid:
                checks.append(self.vpn.status(self.interface))
        with self._lock:
            if self._stop.is_set() or self._ending.is_set():
                return self._poll_interval  # the networks that lead to the machines end with them
            self._poll_interval = min(2 * self._poll_interval, LONGEST_POLL_INTERVAL)
            reports: list[Event] = []
            try:
                if any(process.run(check, check=False, timeout=self._timeout).returncode != 0
                       for check in checks):
                    with step(reports.append, '', 'VPN repair', fatal=False):
                        self._run(self.vpn.repair(self.interface, self._peers()), cancel=False)
                        self._note_owner()
                self._poll_interval, self._failure = POLL_INTERVAL, ''
            except FogError as error:
                # the next check tries again
                before, self._failure = self._failure, str(error)
                if before == self._failure:
                    reports.clear()
            for report in reports:
                self.report(report)
            return self._poll_interval

    def _refresh_ticket(self) -> None:
        """Refresh sudo's ticket, so that the way down needs no password; warn if it has ended."""
        try:
            valid = process.sudo_trouble() is None
        except FogError:
            return  # sudo is slow now; the next refresh tries again
        before, self._ticket_valid = self._ticket_valid, valid
        if before and not self._ticket_valid:
            self.report(StepFailed(
                '', 'sudo ticket', 0.0,
                'sudo wants a password again, so taking this launch down will leave its '
                'containers and its VPN interface (Ctrl-Z, `sudo -v`, `fg` keeps it; else '
                '`sudo -v` and `ros2 fog gc` afterwards)', fatal=False))

    def end(self) -> bool:
        """Stop changing the interface; return whether a part of it may exist."""
        self._stop.set()
        with self._lock:
            self._peer = None
            return self._made


def report_unfiltered(report: Reporter, machine: str, output: str) -> None:
    """Report that a host could not filter DDS, if the commands of its interface printed that."""
    if output.strip():
        report(StepFailed(
            machine, 'DDS filter', 0.0, f'{output.strip()}: its DDS is not filtered '
            '(ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST keeps its nodes from the LAN, control '
            'groups of version 2 give it the filter: doc/dds.md)', fatal=False))


class VpnMember:
    """
    A machine in the VPN, whose peers are updated when other machines join.

    :param run: runs commands on the machine.
    :param health_check: makes the machine's agent check and repair the interface with these
        peers.
    """

    def __init__(
        self, route: plan.Route, interface: VpnInterface,
        run: Callable[[Iterable[Command]], str],
        health_check: Callable[[Sequence[Peer]], object],
    ) -> None:
        self.route = route
        self.name = route.peer.name
        self.interface = interface
        #: ``host:port`` of a relay on the robot that carries its packets, '' for none.
        self.relay = ''
        self._run = run
        self._health_check = health_check
        self._lock = threading.Lock()
        #: Peers of the interface and of its health check; None until the interface is up.
        self._peers: Optional[list[Peer]] = None
        self._checked: Optional[list[Peer]] = None

    @property
    def dialled(self) -> Peer:
        """The machine as the robot dials it."""
        peer = self.route.peer
        return dataclasses.replace(peer, endpoint=self.relay or peer.endpoint)

    def up(self, robot: RobotVpn) -> None:
        """Bring the machine's interface up with its current peers."""
        with self._lock:
            self._peers = robot.peers_of(self)
            report_unfiltered(robot.report, self.name, self._run(
                robot.vpn.up(self.interface, self._peers)))

    def update(self, robot: RobotVpn) -> None:
        """Send the machine and its agent the current peers, if these have changed."""
        with self._lock:
            if self._peers is None:
                return  # ``up`` will use the peers of that moment
            peers = robot.peers_of(self)
            if peers != self._peers:
                self._run(robot.vpn.peers(self.interface, peers))
                self._peers = peers
            if peers != self._checked:
                self._health_check(peers)
                self._checked = peers

    def restore(self, robot: RobotVpn) -> None:
        """Send the current peers to an agent that was started again, and so checks nothing."""
        with self._lock:
            self._checked = None
        self.update(robot)

    def redial(self, robot: RobotVpn, endpoint: str) -> None:
        """Make the machine dial the robot at another ``host:port`` from now on."""
        before = self.route
        self.route = dataclasses.replace(before, robot_endpoint=endpoint)
        try:
            self.update(robot)
        except FogError:
            self.route = before  # so that the next check tries again
            raise
