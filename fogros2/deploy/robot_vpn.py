# SPDX-License-Identifier: Apache-2.0
"""The robot's VPN interface, one for each launch, and the machines that it connects."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import dataclasses
from pathlib import Path
import threading
import time
from typing import Optional, TYPE_CHECKING

from fogros2 import plan, plugin_system, process
from fogros2.errors import Cancelled, CommandError, FogError, VpnError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.report import step, StepFailed
from fogros2.vpn import addresses, helped, Vpn

if TYPE_CHECKING:
    from fogros2.deploy.launch import Launch

#: Seconds between two refreshes of sudo's ticket, which is valid for some minutes.
TICKET_REFRESH = 30.0
#: Seconds that a new machine waits for the others to add it as a peer.
TELLING = 5.0
#: Longest interval in seconds between two attempts to repair the interface.
SELDOM = 15.0


class RobotVpn:
    """The robot's VPN interface, one for each launch, and the machines that it connects."""

    #: True while no part of the interface exists on this computer.
    down = True
    _ticket = True
    _told_of_sudo = False

    def __init__(self, launch: Launch, folder: Path) -> None:
        self._launch = launch
        self._lock = threading.Lock()
        self._up = False
        self._members: dict[str, VpnMember] = {}
        self._public_key = ''
        self._stop = threading.Event()
        self.vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')(
            domain=launch.domain, ports=launch.dds().ports)
        used = addresses.parse_used(launch.robot([addresses.used_networks()]))
        network = addresses.choose_subnet(
            used, launch_id=launch.id, pool=addresses.pool_from(launch.user_environment))
        self.interface = plan.robot_interface(
            launch.id, network, addresses.choose_port(launch.user_environment),
            str(folder / 'vpn.key'))
        if helped.permitted():
            self.interface = dataclasses.replace(
                self.interface, key_file=helped.key_file(self.interface.name))
            # sudo's ticket then serves only container machines: without a ticket, refresh none
            self._ticket = process.refresh_ticket()

    def ensure(self) -> Peer:
        """
        Bring the interface up if it is down; return the robot as the machines' peer.

        :raises Cancelled: the launch has taken the interface down.
        """
        with self._lock:
            if not self._up:
                launch = self._launch
                if self._stop.is_set():
                    # a thread that still updates a machine's peers may come late; nothing would
                    # take the interface down a second time
                    raise Cancelled('the VPN interface')
                with step(launch.report, '', 'VPN interface') as detail:
                    launch.undo.callback(launch.attempt, '', 'VPN interface', self._take_down)
                    self.down = False
                    self._public_key = launch.robot([self.vpn.keys(self.interface)]).strip()
                    self._bring_up()
                    detail.append(f'{self.interface.name} {self.interface.address}')
                self._up = True
                threading.Thread(target=self._keep, name='fog-vpn', daemon=True).start()
            return Peer('robot', self._public_key, self.interface.address)

    def _bring_up(self) -> None:
        try:
            self._launch.robot(self.vpn.up(self.interface, []))
        except CommandError as error:
            if 'Address already in use' in error.result.stderr:
                raise VpnError(
                    f'UDP port {self.interface.port} of this computer is in use already',
                    f'ss -lunp shows by whom; {addresses.PORT_VARIABLE} names another, and '
                    'without it each launch takes a free one') from error
            raise

    def peers_of(self, member: VpnMember) -> list[Peer]:
        """Return the current peers of a machine."""
        robot = self.ensure()
        with self._lock:
            others = [other.place for name, other in sorted(self._members.items())
                      if name != member.name]
        return plan.machine_peers(robot, member.place, others)

    def admit(self, member: VpnMember) -> None:
        """Add a machine to the robot's peers."""
        with self._lock:
            self._members[member.name] = member
            self._launch.robot(self.vpn.peers(self.interface, self._sorted()))

    def spread(self, new: VpnMember) -> None:
        """
        Add a new machine to the peers of the other machines.

        A machine that cannot be updated now is retried in the background.
        """
        new.update(self)
        with self._lock:
            others = [member for member in self._members.values() if member is not new]
        threads = [threading.Thread(target=self._tell, args=(other,), name='fog-peers',
                                    daemon=True) for other in others]
        for thread in threads:
            thread.start()
        until = time.monotonic() + TELLING
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _tell(self, member: VpnMember) -> None:
        """Update a machine's peers; retry until that succeeds."""
        pause = 1.0
        while not self._launch.ending and self._members.get(member.name) is member:
            try:
                member.update(self)
                return
            except FogError as error:
                if pause == 1.0 and not self._launch.ending:
                    self._launch.report(StepFailed(
                        member.name, 'VPN peers', 0.0,
                        f'does not know a new machine yet, trying again: {error}', fatal=False))
            self._stop.wait(pause)
            pause = min(2 * pause, 5.0)

    def remove(self, name: str) -> None:
        """Remove a machine from the robot's peers, unless the whole launch is ending."""
        with self._lock:
            gone = self._members.pop(name, None)
            if gone is not None and self._up and not self._launch.ending:
                self._launch.robot(
                    self.vpn.peers(self.interface, self._sorted()), cancel=False)

    def _sorted(self) -> list[Peer]:
        return [self._members[name].place.peer for name in sorted(self._members)]

    def _keep(self) -> None:
        """Restart the interface's program when it ends; nodes do not notice."""
        asked = time.monotonic()
        pause = 1.0
        while not self._stop.wait(pause):
            if self._ticket and time.monotonic() - asked > TICKET_REFRESH:
                asked = time.monotonic()
                self._refresh_ticket()
            with self._lock:
                if self._stop.is_set():
                    return
                if self._launch.ending:
                    continue  # the networks that lead to the machines end with them
                # report a lasting failure now and then, not every second
                pause = min(2 * pause, SELDOM)
                try:
                    alive = process.run(self.vpn.alive(self.interface), check=False,
                                        timeout=self._launch.timeouts.vpn)
                    if alive.returncode == 0:
                        pause = 1.0
                        continue
                    with step(self._launch.report, '', 'VPN repair', fatal=False):
                        self._launch.robot(
                            self.vpn.repair(self.interface, self._sorted()), cancel=False)
                    pause = 1.0
                except FogError:
                    pass  # the step has reported a failed repair; the next round tries again

    def _refresh_ticket(self) -> None:
        """Refresh sudo's ticket, so that the way down needs no password; warn once if it fails."""
        if process.refresh_ticket():
            self._told_of_sudo = False
        elif not self._told_of_sudo:
            self._told_of_sudo = True
            self._launch.report(StepFailed(
                '', 'sudo ticket', 0.0,
                'sudo wants a password again, so taking this launch down will leave its '
                'containers and its VPN interface (Ctrl-Z, `sudo -v`, `fg` keeps it; else '
                '`sudo -v` and `ros2 fog gc` afterwards)', fatal=False))

    def _take_down(self) -> None:
        self._stop.set()
        with self._lock:
            self._up = False
            self._launch.robot(self.vpn.down(self.interface), cancel=False)
            self.down = True


class VpnMember:
    """
    A machine in the VPN, whose peers are updated when other machines join.

    :param on: runs commands on the machine.
    :param keep: makes the machine's agent repair the interface with these peers.
    """

    def __init__(
        self, place: plan.Place, interface: VpnInterface,
        on: Callable[[Iterable[Command]], str], keep: Callable[[Sequence[Peer]], None],
    ) -> None:
        self.place = place
        self.name = place.peer.name
        self.interface = interface
        self._on = on
        self._keep = keep
        self._lock = threading.Lock()
        #: None until the interface is up.
        self._told: Optional[list[Peer]] = None
        self._kept: Optional[list[Peer]] = None

    def up(self, robot: RobotVpn) -> None:
        """Bring the machine's interface up with its current peers."""
        with self._lock:
            self._told = robot.peers_of(self)
            self._on(robot.vpn.up(self.interface, self._told))

    def update(self, robot: RobotVpn) -> None:
        """Send the machine and its agent the current peers, if these have changed."""
        with self._lock:
            if self._told is None:
                return  # ``up`` will use the peers of that moment
            peers = robot.peers_of(self)
            if peers != self._told:
                self._on(robot.vpn.peers(self.interface, peers))
                self._told = peers
            if peers != self._kept:
                self._keep(peers)
                self._kept = peers

    def redial(self, robot: RobotVpn, endpoint: str) -> None:
        """Make the machine dial the robot at another ``host:port`` from now on."""
        before = self.place
        self.place = dataclasses.replace(before, robot_endpoint=endpoint)
        try:
            self.update(robot)
        except FogError:
            self.place = before  # so that the next check tries again
            raise
