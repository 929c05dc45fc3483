# SPDX-License-Identifier: Apache-2.0
"""The robot's side of one launch: machines, the VPN interface, the DDS configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
import contextlib
from decimal import Decimal
import os
from pathlib import Path
import secrets
import shutil
import threading
import time
from typing import Optional

from fogros2 import (
    bootstrap,
    containers,
    model,
    plan,
    plugin_system,
    process,
    ros2_daemon,
    undeclared,
    wheels,
    workspace,
)
from fogros2 import shell as shells
from fogros2.dds import DdsVendor
from fogros2.deploy import routing
from fogros2.deploy.choosing import Choices
from fogros2.deploy.deployment import Deployment
from fogros2.deploy.robot import check_robot, provider
from fogros2.deploy.robot_vpn import RobotVpn
from fogros2.deploy.running import RunningMachine
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    DdsError,
    FogError,
    PrerequisiteError,
    StoreError,
)
from fogros2.journal import Journal
from fogros2.model import Command, MachineSpec
from fogros2.provider import Provider
from fogros2.report import Reporter, silent, StepFailed
from fogros2.store import boot_id, check_name, process_start, Store, write_private
from fogros2.waiting import Timeouts


class Launch:
    """
    The robot's side of one launch; thread-safe.

    :param report: receives each step when it begins and when it ends.
    :param cancel: when set, every wait of the deployment raises Cancelled.
    :param environment: the environment variables of the launch; ``os.environ`` if None.
    """

    def __init__(
        self, *, store: Optional[Store] = None, report: Reporter = silent,
        timeouts: Optional[Timeouts] = None, environment: Optional[Mapping[str, str]] = None,
        cancel: Optional[threading.Event] = None,
    ) -> None:
        self.id = secrets.token_hex(3)
        self.store = store or Store()
        # `ros2 fog status --watch` and the dashboard read the journal
        self.report: Reporter = Journal(report, self.store.root / 'launches' / self.id)
        self.timeouts = timeouts or Timeouts()
        self.cancel = cancel or threading.Event()
        self.user_environment = dict(os.environ if environment is None else environment)
        self._lock = threading.RLock()
        self.undo = contextlib.ExitStack()
        self._failures: list[FogError] = []
        self._indices: dict[str, int] = {}
        self._ups: dict[str, Future[RunningMachine]] = {}
        self._providers: dict[str, Provider] = {}
        self._programs: dict[str, Sequence[tuple[str, str]]] = {}
        self._images: dict[str, Sequence[str]] = {}
        self.choices = Choices(self.provider, self.report)
        self._robot: Optional[RobotVpn] = None
        self._rmw = ''
        self._robot_environment: Optional[dict[str, str]] = None
        self._closed = False

    # -- before anything is created -------------------------------------------------------------

    def prepare(
        self, specs: Sequence[MachineSpec],
        programs: Mapping[str, Sequence[tuple[str, str]]] = {},
        images: Mapping[str, Sequence[str]] = {},
    ) -> None:
        """
        Check everything that can be checked at no cost, and make the open choices.

        :param programs: machine name to the (package, executable) pairs that will run there.
        :param images: machine name to the container images that nodes there will run in.
        :raises FogError: the first problem that was found, with its remedy.
        """
        self.dds()
        check_robot()
        self._programs.update(programs)
        self._images.update(images)
        names = [spec.name for spec in specs]
        for name in names:
            check_name(name)
            if names.count(name) > 1:
                raise ConfigurationError(f"two machines of this launch are called '{name}'",
                                         'give each a name= of its own')
        prefixes = plan.ament_prefixes(self.user_environment)
        plan.check_rmw(self._rmw, prefixes, specs)
        for spec in specs:
            machines = self.provider(spec.provider)
            shells.warm(machines.shell_kind)
            machines.check(spec)
            if spec.on_exit == 'stop' and not machines.owned:
                raise ConfigurationError(
                    f"'{spec.name}' is a computer that exists already: no launch switches it off",
                    "use on_exit='delete' to leave nothing there, or 'keep'")
            for line in spec.containers:
                containers.check(containers.parse(line), self._rmw)
            if spec.containers or images.get(spec.name):
                machines.check_containers(spec)
            chain = [workspace.inspect(path) for path in spec.workspaces]
            for package, executable in programs.get(spec.name, ()):
                if not spec.options.get('image'):
                    plan.check_program(package, executable, prefixes, spec.workspace)
            # a step that cannot do without reports what is wrong
            with contextlib.suppress(FogError, OSError):
                warned = undeclared.warning(
                    spec, chain, {package for package, _ in programs.get(spec.name, ())},
                    prefixes, machines.shown(spec))
                if warned:
                    self.report(warned)
        choosing = [spec for spec in specs if not self._may_be_kept(spec)]
        with ThreadPoolExecutor(max(1, len(choosing)), 'fog-choose') as pool:
            for choice in [pool.submit(self._choose, spec) for spec in choosing]:
                choice.result()

    def _choose(self, spec: MachineSpec) -> None:
        """Make the open choices of a spec; check that wheels and workspace fit its processor."""
        spec = self.choices.resolved(spec)
        if spec.workspace is None and spec.bootstrap not in ('embedded', 'apt'):
            return  # only the machine's system decides
        architecture = self.provider(spec.provider).architecture(spec)
        if architecture:
            bootstrap.check_architecture(
                spec, architecture,
                workspace.inspect(spec.workspace) if spec.workspace else None, wheels.collect)

    def _may_be_kept(self, spec: MachineSpec) -> bool:
        """Return whether this spec may reuse a machine of an earlier launch, with its choices."""
        folder = self.store.machine(spec.name)
        try:
            before = folder.load() if folder.exists() else None
        except StoreError:
            return False
        return before is not None and before.machine_id is not None \
            and before.provider == spec.provider

    def programs(self, name: str) -> Sequence[tuple[str, str]]:
        """Return the (package, executable) pairs that are known to run on a machine."""
        return self._programs.get(name, ())

    def images(self, name: str) -> Sequence[str]:
        """Return the container images that nodes on a machine are known to run in."""
        return self._images.get(name, ())

    def provider(self, name: str) -> Provider:
        """
        Return the provider with this name; all machines of the launch share it.

        :raises ConfigurationError: there is no such provider.
        """
        with self._lock:
            if name not in self._providers:
                self._providers[name] = provider(name)
                self._providers[name].cancel = self.cancel
            return self._providers[name]

    def cost(self) -> list[tuple[str, Decimal, float]]:
        """
        Return the cost of each machine with a known price, ended machines included.

        Each item is (name, US dollars per hour, seconds that this launch has used the machine).
        """
        return self.choices.cost()

    def use_dds(self, name: str) -> None:
        """
        Select the middleware of all nodes, as if RMW_IMPLEMENTATION had named it.

        :param name: a value of RMW_IMPLEMENTATION, or 'cyclonedds', 'fastdds', 'zenoh'.
        :raises DdsError: no plugin has this name, or the launch already uses another middleware.
        """
        rmw = plan.rmw_of(name, plugin_system.names('fogros2.dds'))
        with self._lock:
            other = self.user_environment.get('RMW_IMPLEMENTATION') or rmw
            if self._robot_environment is not None:
                other = self._rmw
            if other != rmw:
                raise DdsError(f"dds='{name}' contradicts RMW_IMPLEMENTATION={other}",
                               'leave one of the two out')
            self.user_environment['RMW_IMPLEMENTATION'] = rmw
            self._rmw = ''

    def dds(self) -> DdsVendor:
        """
        Return the DDS vendor plugin of the launch.

        :raises DdsError: the user's RMW_IMPLEMENTATION has no plugin, or is not installed.
        """
        if not self._rmw:
            rmw = plan.choose_rmw(self.user_environment, plugin_system.names('fogros2.dds'))
            plan.check_rmw(rmw, plan.ament_prefixes(self.user_environment), ())
            self._rmw = rmw
        vendor: DdsVendor = plugin_system.load('fogros2.dds', self._rmw)(domain=self.domain)
        return vendor

    @property
    def domain(self) -> int:
        """
        The ROS domain of all nodes of the launch.

        :raises ConfigurationError: ROS_DOMAIN_ID is not a number.
        """
        text = self.user_environment.get('ROS_DOMAIN_ID') or '0'
        try:
            return int(text)
        except ValueError:
            raise ConfigurationError(f'ROS_DOMAIN_ID={text} is no number',
                                     'use 0 to 101') from None

    def underlay(self, workspaces: Sequence[str]) -> plan.Underlay:
        """
        Return the paths of the robot's ROS 2 and of workspaces; the first need not be sourced.

        :raises PrerequisiteError: the robot has no ROS 2.
        """
        ros2 = shutil.which('ros2', path=self.user_environment.get('PATH'))
        if ros2 is None:
            raise PrerequisiteError('ros2 is not on PATH', "source ROS 2's setup.bash")
        return plan.underlay(
            workspace.sourced(next(iter(workspaces), None), self.user_environment), workspaces,
            ros2)

    def robot_environment(self) -> dict[str, str]:
        """
        Bring the VPN interface up; return the environment variables of the robot's nodes.

        A node uses the network interfaces that exist when it starts. So the VPN interface has to
        exist before the first node, long before any machine. The first call takes about 0.1 s.

        :raises FogError: this computer cannot create the interface.
        """
        with self._lock:
            if self._robot_environment is None:
                check_robot()
                vendor = self.dds()
                lan = vendor.parse_lan(self.robot([vendor.ask_lan()]))
                robot = self.robot_vpn()
                interfaces = vendor.robot_interfaces(
                    robot.interface.address if vendor.by_address else robot.interface.name,
                    lan, self.user_environment)
                path = self.store.launch(self.id) / vendor.file_name
                # no peers: the machines announce themselves
                write_private(
                    path, vendor.render(interfaces, (), self.user_environment).encode())
                # for terminals that join the launch: they read the domain and the middleware
                write_private(path.with_name('domain'), str(self.domain).encode())
                write_private(path.with_name('rmw'), vendor.rmw.encode())
                robot.ensure()
                # the ROS 2 daemon is a node that uses the interface: it has to end first
                self.undo.callback(ros2_daemon.stop, path.parent)
                self._route(vendor, path.parent)
                self._robot_environment = dict(
                    vendor.environment(str(path), self.user_environment))
            return dict(self._robot_environment)

    def _route(self, vendor: DdsVendor, folder: Path) -> None:
        """Start the router of the robot's nodes, for a middleware that has one."""
        robot = self.robot_vpn().interface
        machines = [
            plan.machine_interface('', robot.network, index, 0, '').address
            for index in range(routing.MACHINES)]
        router = vendor.router(robot.address, machines, self.user_environment)
        if router is not None:
            running = routing.RobotRouter(router, folder, self.user_environment)
            # runs after the robot's nodes have ended, and before the VPN goes down
            self.undo.callback(running.close)

    def expect(self, names: Iterable[str]) -> None:
        """Reserve the VPN addresses of machines, so that nodes that start earlier know them."""
        with self._lock:
            for name in names:
                self._indices.setdefault(name, len(self._indices))

    def index(self, name: str) -> int:
        """Return a machine's number in the VPN."""
        return self._indices[name]

    def addresses_but(self, name: str) -> list[str]:
        """Return the VPN addresses of all known machines except one."""
        network = self.robot_vpn().interface.network
        with self._lock:
            indices = [index for other, index in self._indices.items() if other != name]
        return [plan.machine_interface('', network, index, 0, '').address for index in indices]

    # -- up -------------------------------------------------------------------------------------

    def up(self, spec: MachineSpec) -> RunningMachine:
        """
        Bring a machine up and return it; a second call for the same name waits for the first.

        Blocks until the machine is up, possibly for minutes: call it in a thread.

        :raises FogError: a step failed; its undo steps have removed the machine.
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
            machine = Deployment(self, spec).run()
        except BaseException as error:
            mine.set_exception(error)
            raise
        mine.set_result(machine)
        self._warm()
        return machine

    def _warm(self) -> None:
        """
        Start the machines' launch processes once all machines are up.

        This shortens the start of nodes. Earlier, it would slow down machines on the same
        computer that are still coming up.
        """
        ups = list(self._ups.values())
        if self.ending or not all(up.done() for up in ups):
            return  # a kept machine would keep the process
        for machine in self.machines():
            with contextlib.suppress(FogError):  # the first start of a node reports the same error
                machine.warm()

    def robot_vpn(self) -> RobotVpn:
        """Return the robot's VPN; its interface need not be up yet."""
        with self._lock:
            if self._robot is None:
                folder = self.store.launch(self.id)
                self.undo.callback(self._remove_folder, folder)
                # `ros2 fog gc` reads this to recognise the folder of a killed launch
                pid = os.getpid()
                write_private(folder / 'process.json', model.to_json(
                    {'pid': pid, 'pid_start': process_start(pid),
                     'boot': boot_id()}).encode())
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
        End every machine by its ``on_exit``, then the VPN interface; idempotent.

        Call it after the robot's nodes have exited: they need the interface while they run.
        Returns the errors of undo steps that failed; the other undo steps ran.
        """
        with self._lock:
            self._closed = True
        self.cancel.set()
        ups = dict(self._ups)
        with ThreadPoolExecutor(max(1, len(ups)), 'fog-down') as pool:
            ended = {name: pool.submit(_end, up) for name, up in ups.items()}
        known: dict[str, FogError] = {}
        unexpected: Optional[BaseException] = None
        for name, future in ended.items():
            error = future.exception()
            if isinstance(error, FogError):
                known[name] = error
            else:
                unexpected = unexpected or error
        with self._lock:
            self._ups.clear()
            # whatever failed before, the VPN interface has to go
            self.undo.close()
            failures, self._failures = self._failures + list(known.values()), []
        if unexpected is not None:
            for name, error in known.items():
                # the exception below replaces the return value: report these errors here
                self.report(StepFailed(name, 'end', 0.0, str(error), fatal=False))
            raise unexpected
        return failures

    def attempt(self, machine: str, name: str, undo: Callable[[], None]) -> None:
        """Run an undo step; if it fails, report and remember the error."""
        begin = time.monotonic()
        try:
            undo()
        except FogError as error:
            self.undo_failed(machine, name, error, time.monotonic() - begin)

    def undo_failed(
        self, machine: str, name: str, error: FogError, seconds: float = 0.0,
    ) -> None:
        """Report and remember the error of an undo step."""
        self.report(StepFailed(machine, name, seconds, str(error)))
        with self._lock:
            self._failures.append(error)

    def robot(self, commands: Iterable[Command], *, cancel: bool = True) -> str:
        """Run commands on the robot, one after the other; return the last one's output."""
        output = ''
        for command in commands:
            output = process.run(command, timeout=self.timeouts.vpn,
                                 cancel=self.cancel if cancel else None).stdout
        return output


def _end(up: Future[RunningMachine]) -> None:
    """End a machine; one that is still coming up is cancelled and removes itself."""
    if up.exception() is None:
        up.result().close()
