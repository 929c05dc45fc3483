# SPDX-License-Identifier: Apache-2.0
"""
The one orchestrator: from machine specs to machines that run nodes, and back to nothing.

A :class:`Launch` is the robot's side of one launch: its VPN interface and its DDS configuration.
:meth:`Launch.up` takes one machine through the steps of the paper; several run in parallel, each
in a thread of its caller. Every undo is pushed before its step runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
import contextlib
import dataclasses
import functools
import json
import os
from pathlib import Path
import secrets
import shutil
import threading
import time
from typing import Any, Optional
import uuid

from fogros2 import bootstrap, model, plan, plugin_system, process, workspace
from fogros2 import shell as shells
from fogros2.agent_client import agent_source, AgentClient, Heartbeat
from fogros2.dds import DdsVendor
from fogros2.errors import (
    AgentAbsent,
    AgentError,
    Cancelled,
    CommandError,
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    FogError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    Unsupported,
    VpnError,
)
from fogros2.model import (
    Command,
    CreateRequest,
    Machine,
    MachineSpec,
    MachineState,
    NodeSpec,
    Peer,
    VpnInterface,
)
from fogros2.provider import (
    Provider,
    TAG_EXPIRES,
    TAG_LAUNCH,
    TAG_NAME,
    TAG_ON_EXIT,
    TAG_ROBOT,
)
from fogros2.report import Progress, Reporter, silent, step, StepFailed
from fogros2.shell import Shell
from fogros2.store import (
    check_name,
    MachineDirectory,
    process_start,
    Record,
    robot_name,
    Store,
    write_private,
)
from fogros2.vpn import addresses, Vpn
from fogros2.waiting import Timeouts, wait_until

#: Programs that the robot's side calls, and the Debian packages that have them.
ROBOT_PROGRAMS = {
    'ip': 'iproute2', 'wg': 'wireguard-tools', 'nft': 'nftables', 'rsync': 'rsync',
    'ssh-keygen': 'openssh-client',
}
AGENT_FOLDER = '/run/fogros2'
#: Seconds that one attempt to log in may take: a cancel isn't seen before its end.
LOGIN_ATTEMPT = 10.0
#: Seconds between two uses of sudo's ticket, which lives for some minutes after each.
TICKET_REFRESH = 30.0


class Launch:
    """
    The robot's side of one launch; thread-safe.

    :param report: gets each step as it begins and ends.
    :param cancel: set to make every wait of the deployment end with Cancelled.
    :param environment: the environment that the launch was started in.
    """

    def __init__(
        self, *, store: Optional[Store] = None, report: Reporter = silent,
        timeouts: Optional[Timeouts] = None, environment: Optional[Mapping[str, str]] = None,
        cancel: Optional[threading.Event] = None,
    ) -> None:
        self.id = secrets.token_hex(3)
        self.store = store or Store()
        self.report = report
        self.timeouts = timeouts or Timeouts()
        self.cancel = cancel or threading.Event()
        self.user_environment = dict(os.environ if environment is None else environment)
        self._lock = threading.RLock()
        self._undo = contextlib.ExitStack()
        self._failures: list[FogError] = []
        self._indices: dict[str, int] = {}
        self._ups: dict[str, Future[RunningMachine]] = {}
        self._robot: Optional[RobotVpn] = None
        self._rmw = ''
        self._robot_environment: Optional[dict[str, str]] = None
        self._closed = False

    # -- before anything is created -------------------------------------------------------------

    def prepare(
        self, specs: Sequence[MachineSpec],
        programs: Mapping[str, Sequence[tuple[str, str]]] = {},
    ) -> None:
        """
        Check everything that can be checked at no cost.

        :param programs: per machine name the (package, executable) pairs that will run there.
        :raises FogError: the first thing that is wrong, with its remedy.
        """
        self.dds()
        check_robot()
        names = [spec.name for spec in specs]
        for name in names:
            check_name(name)
            if names.count(name) > 1:
                raise ConfigurationError(f"two machines of this launch are called '{name}'",
                                         'give each a name= of its own')
        prefixes = plan.ament_prefixes(self.user_environment)
        for spec in specs:
            machines = provider(spec.provider)
            shells.warm(machines.shell_kind)
            machines.check(spec)
            if spec.on_exit == 'stop' and not owned(spec):
                raise ConfigurationError(
                    f"'{spec.name}' is a computer that exists already: no launch switches it off",
                    "use on_exit='delete' to leave nothing there, or 'keep'")
            if spec.workspace is not None:
                workspace.inspect(Path(spec.workspace))
            for package, executable in programs.get(spec.name, ()):
                if not spec.options.get('image'):
                    plan.check_program(package, executable, prefixes)

    def dds(self) -> DdsVendor:
        """
        Return the DDS vendor of the launch.

        :raises DdsError: the user's RMW_IMPLEMENTATION is one without a plugin.
        """
        if not self._rmw:
            self._rmw = plan.choose_rmw(self.user_environment, plugin_system.names('fogros2.dds'))
        vendor: DdsVendor = plugin_system.load('fogros2.dds', self._rmw)(domain=self.domain)
        return vendor

    @property
    def domain(self) -> int:
        """
        The ROS domain of all nodes of the launch.

        :raises ConfigurationError: ROS_DOMAIN_ID is no number.
        """
        text = self.user_environment.get('ROS_DOMAIN_ID') or '0'
        try:
            return int(text)
        except ValueError:
            raise ConfigurationError(f'ROS_DOMAIN_ID={text} is no number',
                                     'use 0 to 101') from None

    def underlay(self, workspace_root: Optional[str]) -> plan.Underlay:
        """
        Return the robot's own ROS 2 as paths.

        :raises PrerequisiteError: there is none.
        """
        ros2 = shutil.which('ros2', path=self.user_environment.get('PATH'))
        if ros2 is None:
            raise PrerequisiteError('ros2 is not on PATH', "source ROS 2's setup.bash")
        return plan.underlay(self.user_environment, workspace_root, ros2)

    def robot_environment(self) -> dict[str, str]:
        """
        Return the variables that the robot's nodes need, with the VPN's interface there.

        A node takes the interfaces that it finds when it starts, so this one has to be there
        before the first of them, well before any machine is. It takes a tenth of a second, once.

        :raises FogError: this computer can't have it.
        """
        with self._lock:
            if self._robot_environment is None:
                check_robot()
                vendor = self.dds()
                lan = vendor.parse_lan(self.robot([vendor.ask_lan()]))
                robot = self._robot_vpn()
                interfaces = vendor.robot_interfaces(
                    robot.interface.name, lan, self.user_environment)
                path = self.store.launch(self.id) / 'dds.xml'
                # no peers: the machines announce themselves
                write_private(path, vendor.render(interfaces, ()).encode())
                robot.ensure()
                self._robot_environment = dict(
                    vendor.environment(str(path), self.user_environment))
            return dict(self._robot_environment)

    def expect(self, names: Iterable[str]) -> None:
        """Give machines their addresses ahead, so that nodes started meanwhile know them."""
        with self._lock:
            for name in names:
                self._indices.setdefault(name, len(self._indices))

    def _machine_address(self, name: str) -> str:
        network = self._robot_vpn().interface.network
        return plan.machine_interface('', network, self._indices[name], 0, '').address

    # -- up -------------------------------------------------------------------------------------

    def up(self, spec: MachineSpec) -> RunningMachine:
        """
        Bring a machine up and return it; a second call for the same name joins the first.

        Blocks for as long as it takes: call it in a thread.

        :raises FogError: what failed; nothing of the machine is left then.
        :raises Cancelled: the launch is ending.
        """
        with self._lock:
            if self._closed or self.cancel.is_set():
                raise Cancelled(f"machine '{spec.name}'")
            known = self._ups.get(spec.name)
            if known is None:
                self.expect([spec.name])
                mine: Future[RunningMachine] = Future()
                self._ups[spec.name] = mine
        if known is not None:
            return known.result()
        try:
            machine = _Deployment(self, spec).run()
        except BaseException as error:
            mine.set_exception(error)
            raise
        mine.set_result(machine)
        self._warm()
        return machine

    def _warm(self) -> None:
        """
        Start the machines' launch processes once all machines are up.

        Nodes start sooner by what that takes; before, it would take the processors from machines
        on the same computer that are still coming up.
        """
        ups = list(self._ups.values())
        if self.ending or not all(up.done() for up in ups):
            return  # one that is kept would be left with the process
        for machine in self.machines():
            with contextlib.suppress(FogError):  # the first start would say the same
                machine.warm()

    def _robot_vpn(self) -> RobotVpn:
        """Return the robot's VPN, chosen but not necessarily up."""
        with self._lock:
            if self._robot is None:
                folder = self.store.launch(self.id)
                self._undo.callback(self._remove_folder, folder)
                # by this, `ros2 fog gc` tells the folder of a launch that was killed
                pid = os.getpid()
                write_private(folder / 'process.json', model.to_json(
                    {'pid': pid, 'pid_start': process_start(pid)}).encode())
                self._robot = RobotVpn(self, folder)
            return self._robot

    def _remove_folder(self, folder: Path) -> None:
        """Remove the launch's folder, unless `ros2 fog gc` needs it to find the interface."""
        if self._robot is None or self._robot.down:
            shutil.rmtree(folder, ignore_errors=True)

    @property
    def ending(self) -> bool:
        """Whether the launch is on its way down."""
        return self._closed

    def machines(self) -> list[RunningMachine]:
        """Return the machines that are up now."""
        return [up.result() for up in list(self._ups.values())
                if up.done() and up.exception() is None]

    # -- down -----------------------------------------------------------------------------------

    def down(self) -> list[FogError]:
        """
        End everything, each machine by its ``on_exit``, the VPN's interface last; idempotent.

        Call it when the robot's nodes have exited: they must not lose the interface while they
        run. Returns the undo steps that failed; the others ran all the same.
        """
        with self._lock:
            self._closed = True
        self.cancel.set()
        ups = list(self._ups.values())
        ended: list[Future[None]] = []
        with ThreadPoolExecutor(max(1, len(ups)), 'fog-down') as pool:
            for up in ups:
                # one that still comes up sees the cancel and takes itself away
                if up.exception() is None:
                    ended.append(pool.submit(up.result().close))
        with self._lock:
            self._ups.clear()
            for future in ended:
                self._note(future.exception())
            self._undo.close()
            failures, self._failures = self._failures, []
        return failures

    def _note(self, error: Optional[BaseException]) -> None:
        if isinstance(error, FogError):
            self._failures.append(error)
        elif error is not None:
            raise error

    def attempt(self, machine: str, name: str, undo: Callable[[], None]) -> None:
        """Run an undo step; if it fails, report and remember it, so that the others still run."""
        begin = time.monotonic()
        try:
            undo()
        except FogError as error:
            self.report(StepFailed(machine, name, time.monotonic() - begin, str(error)))
            with self._lock:
                self._failures.append(error)

    def robot(self, commands: Iterable[Command], *, cancel: bool = True) -> str:
        """Run commands on the robot, one after the other; return what the last one printed."""
        output = ''
        for command in commands:
            output = process.run(command, timeout=self.timeouts.vpn,
                                 cancel=self.cancel if cancel else None).stdout
        return output


class RobotVpn:
    """The robot's VPN interface, one per launch, and the machines that it leads to."""

    #: Whether nothing of it is on this computer.
    down = True
    _told_of_sudo = False

    def __init__(self, launch: Launch, folder: Path) -> None:
        self._launch = launch
        self._lock = threading.Lock()
        self._up = False
        self._members: dict[str, VpnMember] = {}
        self._public_key = ''
        self._stop = threading.Event()
        self.vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')(
            domain=launch.domain)
        used = addresses.parse_used(launch.robot([addresses.used_networks()]))
        network = addresses.choose_subnet(
            used, launch_id=launch.id, pool=addresses.pool_from(launch.user_environment))
        self.interface = plan.robot_interface(
            launch.id, network, addresses.choose_port(), str(folder / 'vpn.key'))

    def ensure(self) -> Peer:
        """Bring the interface up if it isn't; return the robot as the machines' peer."""
        with self._lock:
            if not self._up:
                launch = self._launch
                with step(launch.report, '', 'VPN interface') as detail:
                    launch._undo.callback(launch.attempt, '', 'VPN interface', self._take_down)
                    self.down = False
                    self._public_key = launch.robot([self.vpn.keys(self.interface)]).strip()
                    launch.robot(self.vpn.up(self.interface, []))
                    detail.append(f'{self.interface.name} {self.interface.address}')
                self._up = True
                threading.Thread(target=self._keep, name='fog-vpn', daemon=True).start()
            return Peer('robot', self._public_key, self.interface.address)

    def peers_of(self, name: str) -> list[Peer]:
        """Return the peers of a machine as they are now."""
        robot = self.ensure()
        with self._lock:
            return plan.machine_peers(
                robot, name, {n: member.peer for n, member in self._members.items()})

    def add(self, member: VpnMember) -> None:
        """Let the robot, and every machine that is there already, know of a new one."""
        with self._lock:
            self._members[member.peer.name] = member
            self._launch.robot(self.vpn.peers(self.interface, self._sorted()))
            everyone = list(self._members.values())
        for other in everyone:
            other.update(self)

    def remove(self, name: str) -> None:
        """Forget a machine; the robot's interface is told unless it goes as well."""
        with self._lock:
            gone = self._members.pop(name, None)
            if gone is not None and self._up and not self._launch.ending:
                self._launch.robot(
                    self.vpn.peers(self.interface, self._sorted()), cancel=False)

    def _sorted(self) -> list[Peer]:
        return [self._members[name].peer for name in sorted(self._members)]

    def _keep(self) -> None:
        """Get the interface's program going again when it died; nodes don't notice."""
        asked = time.monotonic()
        while not self._stop.wait(1.0):
            if time.monotonic() - asked > TICKET_REFRESH:
                asked = time.monotonic()
                self._refresh_ticket()
            with self._lock:
                if self._stop.is_set():
                    return
                try:
                    alive = process.run(self.vpn.alive(self.interface), check=False,
                                        timeout=self._launch.timeouts.vpn)
                    if alive.returncode == 0:
                        continue
                    with step(self._launch.report, '', 'VPN repair', fatal=False):
                        self._launch.robot(
                            self.vpn.repair(self.interface, self._sorted()), cancel=False)
                except FogError:
                    pass  # a repair's is reported by its step; the next round tries again

    def _refresh_ticket(self) -> None:
        """Keep sudo from wanting a password before all is taken down; say so once if it does."""
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
    """A machine in the VPN: told its peers anew when another joins."""

    def __init__(
        self, peer: Peer, interface: VpnInterface, on: Callable[[Iterable[Command]], str],
        keep: Callable[[], None],
    ) -> None:
        self.peer = peer
        self.interface = interface
        self._on = on
        self._keep = keep
        self._lock = threading.Lock()
        self._told: list[Peer] = []

    def up(self, robot: RobotVpn) -> None:
        """Bring the machine's interface up with the peers of this moment."""
        with self._lock:
            self._told = robot.peers_of(self.peer.name)
            self._on(robot.vpn.up(self.interface, self._told))

    def update(self, robot: RobotVpn) -> None:
        """Tell the machine its peers, unless somebody else just did."""
        with self._lock:
            peers = robot.peers_of(self.peer.name)
            if peers != self._told:
                self._on(robot.vpn.peers(self.interface, peers))
                self._told = peers
                self._keep()

    def repair(self, robot: RobotVpn) -> list[list[str]]:
        """Return the command lines that get the machine's VPN going again."""
        return [list(c.argv) for c in robot.vpn.repair(self.interface, self._told)]


class RunningMachine:
    """A machine of the launch that is up, and the nodes on it."""

    def __init__(
        self, launch: Launch, spec: MachineSpec, machine: Machine, shell: Shell,
        agent: AgentClient, heartbeat: Heartbeat, interface: VpnInterface,
        undo: contextlib.ExitStack,
    ) -> None:
        self.spec = spec
        self.machine = machine
        self.shell = shell
        self.agent = agent
        self.heartbeat = heartbeat
        self.vpn_address = interface.address
        self.interface = interface
        self._launch = launch
        self._undo = undo
        self._warm = False

    def warm(self) -> None:
        """Start the process that will run the nodes, unless it runs."""
        if not self._warm:
            self._warm = True
            self.agent.request('launch')

    def start(self, nodes: Sequence[NodeSpec]) -> None:
        """Start nodes; what becomes of them arrives as events."""
        self.agent.request('start', nodes=[_json(node) for node in nodes])

    def stop(self, ids: Optional[Sequence[str]] = None) -> None:
        """Stop nodes in order (SIGINT, SIGTERM, SIGKILL), all without ``ids``."""
        self.agent.request('stop', nodes=None if ids is None else list(ids))

    def signal(self, node: str, name: str) -> None:
        """Send a node a signal, by its name (``SIGUSR1``)."""
        self.agent.request('signal', node=node, signal=name)

    def subscribe(self, callback: Callable[[dict[str, Any]], None]) -> None:
        """
        Hand every event of the machine from now on to ``callback``.

        It is called from a thread of the connection's, or from one that watches the machine, and
        must not make requests of the agent. Besides what the agent says (see ``agent.py``):

        ``{'event': 'notice', 'reason': ...}``  the provider is about to take the machine away, by
            its own words; once. The agent answers requests still, for as long as they say.
        ``{'event': 'lost', 'reason': ...}``  the machine is gone: ended, stopped, evicted; once,
            and nothing comes after it. Requests fail from now on.
        ``{'event': 'connection', 'state': 'lost' | 'back' | 'absent'}``  the connection's changes.
        ``{'event': 'gap', 'count': n}``  so many events came too late for the agent's log.
        """
        def tell(event: dict[str, Any]) -> None:
            # an agent that leaves at the end as it was told is no news
            if event['event'] != 'connection' or not self._launch.ending:
                callback(event)

        self.agent.subscribe(tell)

    def close(self) -> None:
        """End the machine as its ``on_exit`` says."""
        self._undo.close()


class _Deployment:
    """One machine's way up; its undo stack becomes the running machine's way down."""

    def __init__(self, launch: Launch, spec: MachineSpec) -> None:
        self.launch = launch
        self.spec = spec
        self.name = spec.name
        self.timeouts = launch.timeouts
        self.provider = provider(spec.provider)
        self.folder: MachineDirectory = launch.store.machine(spec.name)
        self.record = Record(spec.name, spec.provider, spec)
        #: Whether the computer is the provider's to make and to end, not somebody's own.
        self.owned = owned(spec)
        self.reused = False
        self.asked = False
        self.released = False
        self.rearming: Optional[_Rearming] = None
        self.failed = True
        #: Set when the launch's is, or when a step failed: those beside it needn't go on.
        self.cancel = _Either(launch.cancel)

    def run(self) -> RunningMachine:
        """Take the steps; on any failure undo those taken."""
        with contextlib.ExitStack() as undo:
            undo.enter_context(self.folder.lock())
            # the robot's side needs nothing of the machine's: it comes up meanwhile
            with ThreadPoolExecutor(4, f'fog-{self.name}') as pool:
                robot = pool.submit(self.launch._robot_vpn().ensure)
                machine = self._create(undo)
                shell = self._connect(machine, undo)
                interface = self._interface()
                agent = self._arm(machine, shell, undo)
                ros = self._prepare_host(shell)
                robot.result()
                joining = pool.submit(self._join_vpn, machine, shell, agent, interface, undo)
                syncing = pool.submit(self._sync, shell, ros)
                configuring = pool.submit(self._configure_dds, shell, interface)
                self._all_of(joining, syncing, configuring)
                public_key = joining.result().peer.public_key
                dds = configuring.result()
            with step(self.launch.report, self.name, 'agent') as detail:
                heartbeat = self._start_agent(agent, interface, ros, dds, undo)
                detail.append(f'VPN round trip {(heartbeat.round_trip or 0) * 1e3:.2f} ms')
            self._save(public_key=public_key)
            # once more, to come first on the way down
            self._undo_nodes(agent, undo)
            self.failed = False
            return RunningMachine(
                self.launch, self.spec, machine, shell, agent, heartbeat, interface,
                undo.pop_all())

    def _all_of(self, *tasks: Future[Any]) -> None:
        """Wait for steps that run side by side; the first that fails ends the others."""
        for task in wait(tasks, return_when=FIRST_EXCEPTION).done:
            if task.exception() is not None:
                self.cancel.set()
                task.result()

    def _save(self, **changes: Any) -> None:
        # known here even where it can't be written down, as the way down needs it
        self.record = dataclasses.replace(self.record, **changes)
        self.folder.save(self.record)

    # -- steps 1 to 3: create, wait, pin --------------------------------------------------------

    def _create(self, undo: contextlib.ExitStack) -> Machine:
        with step(self.launch.report, self.name, 'machine') as detail:
            kept = self._kept()
            if kept is not None:
                self._adopt(kept, undo)
                detail.append('kept from before')
            else:
                self._create_new(undo)
            machine = wait_until(
                self._reachable, timeout=self.timeouts.boot, cancel=self.cancel,
                what=f"the machine '{self.name}' to run", longest=self._poll_longest())
            self._save(shell=machine.shell)
            detail.append(machine.shell.host if machine.shell else machine.id[:20])
            return machine

    def _poll_longest(self) -> float:
        return 0.1 if self.spec.provider in ('container', 'ssh') else 3.0

    def _kept(self) -> Optional[Machine]:
        """Return the machine of this name that an earlier launch kept or stopped, if any."""
        if self.folder.exists():
            before = self.folder.load()
            if before.launch_alive:
                raise NameTaken(
                    f"the launch with process {before.pid} has the machine '{self.name}'",
                    'give the machine another name=, or end that launch')
            if before.provider != self.spec.provider:
                raise NameTaken(
                    f"'{self.name}' is a machine of the provider '{before.provider}'",
                    f'give the machine another name=, or: ros2 fog delete {self.name}')
            if before.machine_id is not None:
                with contextlib.suppress(MachineNotFound):
                    machine = self.provider.describe(before.machine_id)
                    if machine.state is not MachineState.DELETED:
                        self._check_alike(before.spec, machine)
                        self.record = dataclasses.replace(before, spec=self.spec)
                        return machine
        try:
            found = list(self.provider.find({TAG_NAME: self.name}))
        except Unsupported:
            return None
        for machine in found:
            owner = machine.tags.get(TAG_ROBOT, '?')
            whose = 'this robot' if owner == robot_name() else f"the robot '{owner}'"
            raise NameTaken(
                f"{whose} has a machine '{self.name}' that this launch has no key for",
                f'give the machine another name=, or: ros2 fog delete {self.name}')
        return None

    def _check_alike(self, before: MachineSpec, machine: Machine) -> None:
        """Refuse to take a machine for another one than it was asked to be."""
        then, now = (json.loads(model.to_json(s.options)) for s in (before, self.spec))
        other = sorted(key for key in {*then, *now} if then.get(key) != now.get(key))
        if other:
            raise NameTaken(
                f"the machine '{self.name}' of an earlier launch has another {', '.join(other)}",
                f'give the machine another name=, or: ros2 fog delete {self.name}')
        if self.spec.on_exit == 'stop' and machine.tags.get(TAG_ON_EXIT, 'stop') != 'stop':
            raise ConfigurationError(
                f"the machine '{self.name}' was not made to be stopped and started",
                f"keep it with on_exit='keep', or: ros2 fog delete {self.name}")

    def _adopt(self, machine: Machine, undo: contextlib.ExitStack) -> None:
        self.reused = True
        undo.callback(self.launch.attempt, self.name, 'end', self._end)
        self._claim(self.record.token)
        if machine.state in (MachineState.STOPPED, MachineState.STOPPING):
            self.provider.start(machine.id)

    def _create_new(self, undo: contextlib.ExitStack) -> None:
        token = str(uuid.uuid4())
        self.folder.delete()
        undo.callback(self.launch.attempt, self.name, 'end', self._end)
        self._claim(token)
        public_key = self._login_key() if self.owned else ''
        config = {}
        if self.provider.agent_directory:
            config = plan.agent_config(
                self.spec, self.launch.id, self.provider.agent_directory, [])
            config['boot_timeout'] = self.timeouts.boot + self.timeouts.ssh
        tags = {
            TAG_NAME: self.name, TAG_ROBOT: robot_name(), TAG_LAUNCH: self.launch.id,
            TAG_EXPIRES: str(int(time.time() + self.spec.lifetime)),
            TAG_ON_EXIT: self.spec.on_exit,
        }
        self.asked = True
        machine_id = self.provider.create(self.spec, CreateRequest(
            token=token, authorized_key=public_key, tags=tags,
            vpn_port=plan.machine_port(self.launch.id), agent_config=config,
            cancel=self.cancel))
        self._save(machine_id=machine_id)

    def _claim(self, token: str) -> None:
        """Write down that this launch has the machine, before there is anything to lose."""
        pid = os.getpid()
        self._save(
            token=token, created=self.record.created or time.time(), armed=time.time(),
            launch=self.launch.id,
            pid=pid, pid_start=process_start(pid) or 0,
            robot_vpn=self.launch._robot_vpn().interface)

    def _login_key(self) -> str:
        path = self.folder.key_file
        process.run(Command((
            'ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', f'fogros2-{self.name}',
            '-f', str(path)), what='make the login key'), timeout=self.timeouts.command)
        return path.with_suffix('.pub').read_text().strip()

    def _reachable(self) -> Optional[Machine]:
        assert self.record.machine_id is not None
        machine = self.provider.describe(self.record.machine_id)
        if machine.state in (MachineState.DELETED, MachineState.STOPPING):
            raise ProviderError(f"the machine '{self.name}' ended while it was coming up",
                                "the provider's own log says why")
        return machine if machine.state is MachineState.RUNNING and machine.shell else None

    def _connect(self, machine: Machine, undo: contextlib.ExitStack) -> Shell:
        with step(self.launch.report, self.name, 'connect'):
            assert machine.shell is not None
            endpoint = machine.shell
            if self.owned:
                endpoint = dataclasses.replace(endpoint, key_file=str(self.folder.key_file))
            self._save(shell=endpoint)
            shell = shells.connect(endpoint, name=self.name, timeout=self.timeouts.ssh)
            undo.callback(shell.close)
            self._log_in(shell)
            return shell

    def _log_in(self, shell: Shell) -> None:
        """Wait until the machine's SSH server lets us in; else say what it answered last."""
        last: Optional[FogError] = None

        def probe() -> bool:
            nonlocal last
            try:
                shell.run(Command(('true',), what='connect'), cancel=self.cancel,
                          timeout=min(LOGIN_ATTEMPT, self.timeouts.ssh))
                return True
            except (ConnectError, DeadlineExceeded) as error:
                last = error
                return False

        try:
            wait_until(probe, timeout=self.timeouts.ssh, cancel=self.cancel, longest=0.5,
                       what=f"'{self.name}' to let us in")
        except DeadlineExceeded as error:
            raise last or error from error

    # -- step 4: ROS on the machine -------------------------------------------------------------

    def _prepare_host(self, shell: Shell) -> bootstrap.RosInstall:
        with step(self.launch.report, self.name, 'ROS 2') as detail:
            ros, note = bootstrap.ensure(
                shell, self.launch.underlay(self.spec.workspace), self.spec,
                timeout=self.timeouts.install, cancel=self.cancel)
            detail.append(note)
            return ros

    # -- step 5: VPN ----------------------------------------------------------------------------

    def _interface(self) -> VpnInterface:
        robot = self.launch._robot_vpn().interface
        port = self.record.vpn.port if self.record.vpn else plan.machine_port(self.launch.id)
        interface = plan.machine_interface(
            self.launch.id, robot.network, self.launch._indices[self.name], port,
            f'{self._agent_directory()}/vpn.key')
        self._save(vpn=interface)
        return interface

    def _join_vpn(
        self, machine: Machine, shell: Shell, agent: AgentClient, interface: VpnInterface,
        undo: contextlib.ExitStack,
    ) -> VpnMember:
        with step(self.launch.report, self.name, 'VPN') as detail:
            robot = self.launch._robot_vpn()
            undo.callback(
                self.launch.attempt, self.name, 'VPN',
                lambda: self._leave_vpn(shell, agent, interface))
            undo.callback(
                self.launch.attempt, self.name, 'VPN', lambda: robot.remove(self.name))
            public_key = self._on(shell, [robot.vpn.keys(interface)]).strip()
            member = VpnMember(
                Peer(self.name, public_key, interface.address,
                     f'{machine.vpn_host}:{interface.port}'),
                interface, lambda commands: self._on(shell, commands),
                lambda: self._keep_vpn(agent, member))
            try:
                member.up(robot)
            except CommandError as error:
                if 'Address already in use' in error.result.stderr:
                    raise VpnError(
                        f"UDP port {interface.port} of '{self.name}' is in use already",
                        'launch again: each launch takes another port') from error
                raise
            robot.add(member)
            self._keep_vpn(agent, member)
            detail.append(interface.address)
            return member

    def _keep_vpn(self, agent: AgentClient, member: VpnMember) -> None:
        """Have the agent repair the machine's VPN when its program dies."""
        robot = self.launch._robot_vpn()
        agent.request(
            'keep', timeout=self.timeouts.agent, what='vpn', interval=1.0,
            alive=list(robot.vpn.alive(member.interface).argv), repair=member.repair(robot),
            down=[list(c.argv) for c in robot.vpn.down(member.interface)])

    def _leave_vpn(self, shell: Shell, agent: AgentClient, interface: VpnInterface) -> None:
        if self._survives():
            # or the agent would take the interface for a broken one
            self.launch.attempt(self.name, 'nodes', lambda: self._release(agent))
            self._on(shell, self.launch._robot_vpn().vpn.down(interface), cancel=False)

    def _on(self, shell: Shell, commands: Iterable[Command], *, cancel: bool = True) -> str:
        output = ''
        for command in commands:
            output = shell.run(
                command, timeout=self.timeouts.vpn,
                cancel=self.cancel if cancel else None).stdout
        return output

    # -- steps 6 and 7: workspace, DDS ----------------------------------------------------------

    def _sync(self, shell: Shell, ros: bootstrap.RosInstall) -> None:
        if self.spec.workspace is None:
            return
        with step(self.launch.report, self.name, 'workspace') as detail:
            note = workspace.transfer(
                shell, Path(self.spec.workspace), ros, timeouts=self.timeouts,
                cancel=self.cancel,
                on_progress=lambda done, total: self.launch.report(
                    Progress(self.name, 'workspace', done, total)))
            detail.append(note)

    def _configure_dds(self, shell: Shell, interface: VpnInterface) -> dict[str, str]:
        vendor = self.launch.dds()
        # the robot hears of a machine by multicast, machines of each other by asking
        with self.launch._lock:
            peers = [self.launch._machine_address(name)
                     for name in self.launch._indices if name != self.name]
        path = f'{self._agent_directory()}/dds.xml'
        shell.put(
            vendor.render(vendor.machine_interfaces(interface.name), peers).encode(),
            path, mode=0o600, timeout=self.timeouts.command)
        return dict(vendor.environment(path, {}))

    # -- steps 8 to 11: the agent ---------------------------------------------------------------

    def _agent_directory(self) -> str:
        return self.provider.agent_directory or f'{AGENT_FOLDER}/{self.name}'

    def _arm(self, machine: Machine, shell: Shell, undo: contextlib.ExitStack) -> AgentClient:
        """Make sure that an agent guards the machine, before anything slow."""
        directory = self._agent_directory()
        program = self.provider.agent_program
        config = plan.agent_config(
            self.spec, self.launch.id, directory, machine.end_command)
        config['user'] = machine.shell.user if machine.shell else ''
        # from here on we speak to it all the time, first to re-arm it, then by heartbeats
        config['boot_timeout'] = self.spec.robot_timeout
        with step(self.launch.report, self.name, 'guard'):
            agent = None
            if not program:
                program = f'{directory}/agent.py'
                remove = functools.partial(self._remove_agent, shell, directory)
                if self._on(shell, [Command.script(
                        f'[ ! -S {directory}/agent.sock ] || echo there', sudo=True,
                        what='look for an agent')]).strip():
                    # of a launch that died, or of another robot, whose it stays
                    agent = self._reach_agent(shell, directory, program, config)
                undo.callback(self.launch.attempt, self.name, 'guard', remove)
                if agent is None:
                    self._install_agent(shell, directory, program, config)
            self._save(agent=directory, agent_program=program)
            agent = agent or wait_until(
                lambda: self._reach_agent(shell, directory, program, config),
                timeout=self.timeouts.agent, cancel=self.cancel,
                what=f"the agent of '{self.name}'")
            undo.callback(agent.close)
            undo.callback(self.launch.attempt, self.name, 'guard', lambda: self._release(agent))
            self.rearming = _Rearming(agent, self.launch.id, self.spec.robot_timeout / 4)
            undo.callback(self.rearming.close)
            return agent

    def _install_agent(
        self, shell: Shell, directory: str, program: str, config: Mapping[str, Any],
    ) -> None:
        self._on(shell, [Command.script(
            f'install -d -m 755 {AGENT_FOLDER}; '
            f'install -d -m 700 -o {config["user"]} {directory}', sudo=True,
            what="make the agent's folder")])
        shell.put(agent_source().read_bytes(), program, mode=0o700)
        shell.put(model.to_json(config).encode(), f'{directory}/config.json', mode=0o600)
        self._on(shell, [Command(
            ('python3', '-IS', program, 'serve', '--detach', '--config',
             f'{directory}/config.json'), sudo=True, what='start the agent')])

    def _reach_agent(
        self, shell: Shell, directory: str, program: str, config: Mapping[str, Any],
    ) -> Optional[AgentClient]:
        """
        Return a connection to the machine's agent, ours from now on; None while there is none.

        :raises AgentError: another launch has it.
        """
        # no cancel: it is needed on the way down as well, and requests have deadlines
        agent = AgentClient(shell, directory, agent_path=program)
        try:
            # the record said that the launch before is gone: its agent may not know yet
            agent.request('configure', timeout=self.timeouts.agent, force=self.reused, **config)
        except FogError as error:
            agent.close()
            if isinstance(error, AgentAbsent):
                return None  # the machine's SSH server may be there before its agent
            raise
        return agent

    def _remove_agent(self, shell: Shell, directory: str) -> None:
        if self._survives():
            # one that was released has left; one that was never reached hasn't
            self._on(shell, [Command.script(
                f'running() {{ [ "$(head -c 6 /proc/$pid/cmdline 2>/dev/null)" = python ]; }}\n'
                f'if read -r pid 2>/dev/null <{directory}/agent.pid && running; then\n'
                f'  kill -s TERM $pid; n=0\n'
                f'  while running && [ $n -lt 100 ]; do sleep 0.1; n=$((n + 1)); done\n'
                f'fi\n'
                f'rm -rf -- {directory}', sudo=True, what='remove the agent')], cancel=False)

    def _start_agent(
        self, agent: AgentClient, interface: VpnInterface, ros: bootstrap.RosInstall,
        dds: Mapping[str, str], undo: contextlib.ExitStack,
    ) -> Heartbeat:
        robot = self.launch._robot_vpn().interface
        try:
            agent.request(
                'configure', timeout=self.timeouts.agent,
                heartbeat={'bind': interface.address, 'port': plan.HEARTBEAT_PORT,
                           'peer': robot.address},
                environment={**ros.environment, **dds, **self.spec.environment},
                setup=list(ros.setup), ros_command=list(ros.command))
        except AgentError as error:
            if 'in use' in str(error):
                raise VpnError(
                    f"UDP port {plan.HEARTBEAT_PORT} of '{self.name}' is in use already",
                    f"end what listens there: ss -lunp 'sport = :{plan.HEARTBEAT_PORT}'"
                ) from error
            raise
        heartbeat = Heartbeat(interface.address, plan.HEARTBEAT_PORT, self.launch.id)
        undo.callback(heartbeat.close)
        try:
            wait_until(
                lambda: heartbeat.round_trip is not None, timeout=self.timeouts.vpn,
                cancel=self.cancel, what='an answer through the VPN', longest=0.05)
        except FogError as error:
            if isinstance(error, Cancelled):
                raise
            raise VpnError(
                f"nothing comes back from '{self.name}' through the VPN",
                f'is UDP port {interface.port} open on the way there?') from error
        if self.rearming is not None:
            self.rearming.close()
        return heartbeat

    # -- the way down ---------------------------------------------------------------------------

    def _undo_nodes(self, agent: AgentClient, undo: contextlib.ExitStack) -> None:
        """Push what comes first on the way down: the nodes end."""
        undo.callback(self.launch.attempt, self.name, 'nodes', lambda: self._release(agent))

    def _release(self, agent: AgentClient) -> None:
        """Have the agent of a computer that stays end the nodes and let go of it; once."""
        if not self._survives() or self.released:
            return
        self.released = True
        if self.rearming is not None:
            self.rearming.close()
        with contextlib.suppress(AgentAbsent):
            # answers when the nodes are gone; out of reach, its watch gets there by itself
            agent.request('release', timeout=self.timeouts.command,
                          on_exit=self.spec.on_exit, exit=not self.provider.agent_program)

    def _survives(self) -> bool:
        """Whether the computer stays when the launch ends, so that it has to be tidied up."""
        if self.failed and not self.reused:
            return not self.owned
        return self.spec.on_exit == 'keep' or not self.owned

    def _end(self) -> None:
        """End the machine by its ``on_exit``; the record goes only when the machine has gone."""
        mode = self.spec.on_exit
        if self.failed and not self.reused:
            mode = 'delete'
        with step(self.launch.report, self.name, mode if self.owned else 'let go'):
            if mode == 'delete':
                for machine_id in self._made():
                    self.provider.destroy(machine_id)
                self.folder.delete()
                return
            if mode == 'stop' and self.record.machine_id is not None:
                self.provider.stop(self.record.machine_id)
            self._save(launch='', pid=0, pid_start=0, robot_vpn=None)


    def _made(self) -> list[str]:
        """Return the id of the machine; a creation that failed half-way is found by its tags."""
        if self.record.machine_id is not None:
            return [self.record.machine_id]
        if not self.asked:
            return []
        try:
            return [machine.id for machine in self.provider.find(
                {TAG_NAME: self.name, TAG_LAUNCH: self.launch.id})]
        except Unsupported:
            return []


class _Either(threading.Event):
    """An event that counts as set when another one is set, too."""

    def __init__(self, other: threading.Event) -> None:
        super().__init__()
        self._other = other

    def is_set(self) -> bool:
        """Return whether one of the two is set."""
        return super().is_set() or self._other.is_set()

    def wait(self, timeout: Optional[float] = None) -> bool:
        """Wait for the other one, a Ctrl-C; that this one was set is seen after ``timeout``."""
        return self._other.wait(timeout) or self.is_set()


class _Rearming:
    """Tells an agent that the launch lives for as long as the VPN has no heartbeat yet."""

    def __init__(self, agent: AgentClient, launch_id: str, interval: float) -> None:
        self._agent = agent
        self._launch_id = launch_id
        self._interval = interval
        self._done = threading.Event()
        threading.Thread(target=self._run, name='fog-rearm', daemon=True).start()

    def _run(self) -> None:
        while not self._done.wait(self._interval):
            try:
                self._agent.request('configure', launch=self._launch_id)
            except FogError:
                pass  # the next one may get through; the step under way says what is wrong

    def close(self) -> None:
        """Stop: heartbeats go on in its place."""
        self._done.set()


def provider(name: str) -> Provider:
    """
    Return the provider of that name.

    :raises ConfigurationError: there is none.
    """
    instance: Provider = plugin_system.load('fogros2.provider', name)()
    return instance


def owned(spec: MachineSpec) -> bool:
    """Return whether the computer is the provider's to make and to end, not somebody's own."""
    return spec.provider != 'ssh'


def check_robot() -> None:
    """
    Check that this computer can be the robot's end of a VPN.

    :raises PrerequisiteError: a program, a right or a device is missing.
    """
    process.require(list(ROBOT_PROGRAMS), package_of=ROBOT_PROGRAMS)
    if os.geteuid() != 0:
        check_sudo()
    if not Path('/dev/net/tun').exists():
        raise PrerequisiteError('/dev/net/tun is missing on this computer', 'sudo modprobe tun')


def check_sudo() -> None:
    """
    Check that root's commands run without a question in the middle of a launch.

    :raises PrerequisiteError: they don't.
    """
    if process.which('sudo') is None:
        raise PrerequisiteError('a VPN interface takes root, and there is no sudo here',
                                'run the launch as root, or install sudo')
    if not process.refresh_ticket():
        raise PrerequisiteError('a VPN interface takes root, and sudo wants a password',
                                'run `sudo -v` first, then launch again')


def _json(node: NodeSpec) -> dict[str, Any]:
    return {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}


def cleanup(record: Record, store: Store, report: Reporter = silent) -> None:
    """
    Take away what a launch that died left on the robot for a machine that is gone.

    Its VPN interface with its program and filter, the launch's folder, the machine's folder with
    its keys. A launch that still runs keeps its own; idempotent.

    :raises FogError: something could not be taken away; the record stays then.
    """
    if record.robot_vpn is not None and record.launch and not record.launch_alive:
        with step(report, record.name, 'VPN interface'):
            vpn: Vpn = plugin_system.load('fogros2.vpn', record.spec.vpn)()
            for command in vpn.down(record.robot_vpn):
                process.run(command, timeout=Timeouts().vpn)
            shutil.rmtree(store.launch(record.launch), ignore_errors=True)
    store.machine(record.name).delete()
