# SPDX-License-Identifier: Apache-2.0
"""The robot's side of one launch: machines, the VPN interface, the DDS configuration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
import contextlib
import dataclasses
import functools
import os
from pathlib import Path
import secrets
import threading
from typing import Optional

from fogros2 import model, plan, plugin_system, ros2_daemon
from fogros2.dds import addresses_of, DdsVendor
from fogros2.deploy import robot_router
from fogros2.deploy.checks import (
    check,
    check_architecture,
    check_here,
    check_names,
    check_stop,
    check_together,
)
from fogros2.deploy.choosing import Choices
from fogros2.deploy.context import Context, programs_of
from fogros2.deploy.deployment import bring_up
from fogros2.deploy.robot import check_robot, clear, firewall_trouble, provider, run
from fogros2.deploy.robot_vpn import choose_interface, RobotVpn
from fogros2.deploy.running import RunningMachine
from fogros2.deploy.undo import UndoStack
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    DdsError,
    FogError,
    MachineNotFound,
    naming,
    PrerequisiteError,
    StoreError,
)
from fogros2.feature import Cost
from fogros2.journal import Journal
from fogros2.model import DdsInterface, MachineSpec, MachineState, NodeSpec, OtherVpn
from fogros2.provider import Provider
from fogros2.report import Reporter, silent, step, StepFailed, Warned
from fogros2.store import delete_folder, hold, Record, Store, this_process, write_private
from fogros2.vpn import addresses, Vpn
from fogros2.waiting import in_thread, Timeouts

#: Seconds for the checks that come before the robot's VPN interface.
_QUICK = 3.0


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
        # `ros2 fog status --watch` reads the journal
        self.report: Reporter = Journal(report, self.store.root / 'launches' / self.id)
        self.timeouts = timeouts or Timeouts()
        self.cancel = cancel or threading.Event()
        self._ending = threading.Event()
        self.user_environment = dict(os.environ if environment is None else environment)
        self._lock = threading.RLock()
        self._failures: list[FogError] = []
        self.undo = UndoStack(self.report, '', self._failures)
        self._indices: dict[str, int] = {}
        self._ups: dict[str, Future[RunningMachine]] = {}
        self._providers: dict[str, Provider] = {}
        self._nodes: dict[str, Sequence[NodeSpec]] = {}
        self._choices = Choices(self.provider, self.report)
        self._vpn: Optional[RobotVpn] = None
        self._rmw = ''
        self._interfaces: list[DdsInterface] = []
        self._robot_environment: Optional[dict[str, str]] = None
        #: The VPNs of other robots to whose machines the robot's filter lets DDS pass.
        self._others: list[OtherVpn] = []
        #: The VPNs of other robots that this launch has joined, by the names of machines here.
        self._joined: dict[str, OtherVpn] = {}

    # -- before anything is created -------------------------------------------------------------

    def check_here(
        self, specs: Sequence[MachineSpec], programs: Mapping[str, Sequence[tuple[str, str]]] = {},
    ) -> None:
        """
        Check what is quick and needs no rights, before :meth:`robot_environment` asks for them.

        :param specs: machines with different names.
        :param programs: machine name to the (package, executable) pairs that will run there.
        :raises FogError: the first problem that was found, with its remedy.
        """
        answers = [in_thread(functools.partial(
            check_here, spec, self.provider(spec.provider), programs.get(spec.name, ()),
            self.user_environment)) for spec in specs]
        done = futures.wait(answers, _QUICK, futures.FIRST_EXCEPTION).done
        for spec, answer in zip(specs, answers):
            if answer in done:
                with naming(spec.name):
                    answer.result()
        self._others = [
            other for spec in specs
            if (other := self.provider(spec.provider).other_vpn(spec)) is not None]

    def prepare(
        self, specs: Sequence[MachineSpec],
        nodes: Mapping[str, Sequence[NodeSpec]] = {},
    ) -> None:
        """
        Check everything that can be checked at no cost, and make the open choices.

        :param nodes: machine name to the nodes that will run there.
        :raises FogError: the first problem that was found, with its remedy.
        """
        rmw = self.dds().rmw
        check_robot()
        self._nodes.update(nodes)
        self._warn_of_crowds()
        check_names(specs)
        plan.check_rmw(rmw, plan.ament_prefixes(self.user_environment), specs)
        plan.check_domain(self.domain, specs)
        plan.check_security(self.user_environment, specs)
        self._check_router(specs)
        for spec in specs:
            with naming(spec.name):
                check(spec, self.provider(spec.provider), environment=self.user_environment,
                      programs=programs_of(nodes.get(spec.name, ())), report=self.report)
        with ThreadPoolExecutor(max(1, len(specs)), 'fog-choose') as pool:
            choices = [pool.submit(naming(spec.name)(self._choose), spec) for spec in specs]
            chosen = [choice.result() for choice in choices]
        check_together([cost.spec for cost in self.costs() if not cost.ended])
        # each counts what all cost
        for spec in filter(None, chosen):
            self._choices.limited(spec)

    def _check_router(self, specs: Sequence[MachineSpec]) -> None:
        """Check that the robot's router, where the middleware has one, can have all machines."""
        names = {*self._indices, *(spec.name for spec in specs)}
        if len(names) > robot_router.MACHINES and self.dds().router('', (), None) is not None:
            raise DdsError(
                f"the launch has {len(names)} machines, and the robot's router can have "
                f'{robot_router.MACHINES}',
                'use several launches, or another RMW_IMPLEMENTATION')

    def _warn_of_crowds(self) -> None:
        """Warn if machines have more processes than those of other machines discover."""
        limit = self.dds().asked_processes
        crowded = sorted(name for name, nodes in self._nodes.items() if len(nodes) > limit)
        if len(crowded) > 1:
            self.report(Warned(
                '', f"{', '.join(crowded)} run more than {limit} processes each: with "
                f'{self.dds().rmw}, further ones of two machines may not discover each other',
                'use another RMW_IMPLEMENTATION, or several nodes in one process (components)'))

    def _choose(self, spec: MachineSpec) -> Optional[MachineSpec]:
        """Make the open choices of a spec; return it unless a kept machine may fit."""
        place = self._places(spec)[0]
        before = self._before(spec)
        if before is None or before.provider != place.provider or not self._exists(before):
            return self._check_choices(place)
        kept = dataclasses.replace(place, options=before.spec.options)
        self._choices.expect(kept, self._choices.price(kept))
        return None

    def _check_choices(self, place: MachineSpec) -> MachineSpec:
        """Make the open choices of a spec; check that wheels and workspace fit its processor."""
        check_stop(place, self.provider(place.provider))
        chosen = self._choices.resolved(place)
        self._choices.expect(chosen, self._choices.price(chosen))
        check_architecture(chosen, self.provider(place.provider))
        return chosen

    def _places(self, spec: MachineSpec) -> list[MachineSpec]:
        """Return the specs to try; a kept machine with the same requirements stays where it is."""
        if not self.provider(spec.provider).capabilities.places:
            return [spec]
        before = self._before(spec)
        if before is not None and before.spec.wanted is not None and (
                model.to_json(before.spec.wanted) == model.to_json(spec.options)
                ) and self._exists(before):
            return [dataclasses.replace(
                spec, provider=before.provider, options=before.asked,
                wanted=spec.options)]
        return self._choices.places(spec)

    def _before(self, spec: MachineSpec) -> Optional[Record]:
        """Return the record of an earlier launch whose machine this spec may reuse, or None."""
        try:
            before = self.store.load(spec.name) if self.store.exists(spec.name) else None
        except StoreError:
            return None
        return before if before is not None and before.machine_id is not None else None

    def _exists(self, before: Record) -> bool:
        """Return whether the machine of a record with its id has not expired meanwhile."""
        assert before.machine_id is not None
        with contextlib.suppress(MachineNotFound):
            machine = self.provider(before.provider).describe(before.machine_id)
            if machine.state is MachineState.RUNNING:
                self._choices.running[machine.id] = machine
            return machine.state is not MachineState.DELETED
        return False

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

    def costs(self) -> list[Cost]:
        """Return what each machine costs, those that have ended or will be created included."""
        return self._choices.costs()

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
        return plan.read_domain(self.user_environment.get('ROS_DOMAIN_ID', ''))

    def drops(self, environment: Mapping[str, str]) -> bool:
        """Return whether the robot's filter drops the DDS of a node with these variables."""
        with contextlib.suppress(ConfigurationError):  # the node itself refuses to start
            own = plan.read_domain(environment.get('ROS_DOMAIN_ID', ''))
            return own != self.domain and bool(self.dds().ports)
        return False

    # -- the robot ------------------------------------------------------------------------------

    def robot_environment(self) -> dict[str, str]:
        """
        Bring the VPN interface up; return the environment variables of the robot's nodes.

        A node uses the network interfaces that exist when it starts. So the VPN interface has to
        exist before the first node, long before any machine. The first call takes about 0.1 s.

        :raises FogError: this computer cannot create the interface.
        """
        with self._lock:
            if self._robot_environment is None:
                vendor, user = self.dds(), self.user_environment
                check_robot()
                vpn = self.robot_vpn()
                path = self.store.launch_folder(self.id) / vendor.file_name
                with step(self.report, '', 'middleware') as detail:
                    detail.append(vendor.rmw)
                    lan = vendor.parse_lan(run(
                        [vendor.ask_lan()], timeout=self.timeouts.vpn, cancel=self.cancel))
                    self._interfaces = vendor.robot_interfaces(
                        vpn.interface.address if vendor.by_address else vpn.interface.name,
                        lan, user)
                    self._write_interfaces()
                    # for terminals that join the launch: they read domain and middleware
                    write_private(path.with_name('domain'), str(self.domain).encode())
                    write_private(path.with_name('rmw'), vendor.rmw.encode())
                vpn.ensure()
                with contextlib.suppress(FogError):
                    # sudo would log a refusal for each user of the helper
                    if not vpn.helped and (trouble := firewall_trouble()):
                        self.report(Warned('', *trouble))
                router = vendor.router(
                    vpn.interface.address,
                    [self._address(index) for index in range(robot_router.MACHINES)], user)
                if router is not None:
                    # ends after the robot's nodes have ended, and before the VPN goes down
                    self.undo.callback(robot_router.run(router, path.parent, user))
                    if router.beside and robot_router.answers(*router.beside):
                        self.report(Warned(
                            '', "the launch's nodes do not reach the nodes of another "
                            f'{router.executable} on this robot',
                            f'ROS_STATIC_PEERS={router.beside[0]} connects machines to them, too'))
                self._robot_environment = dict(vendor.environment(str(path), user))
            return dict(self._robot_environment)

    def programs(self) -> Optional[Path]:
        """Return the folder to put first into PATH of the robot's processes, None for none."""
        # a launch itself needs no daemon, and another account may have taken all ports
        with contextlib.suppress(PrerequisiteError):
            return ros2_daemon.programs(self.store.launch_folder(self.id))
        return None

    def _write_interfaces(self) -> None:
        """Write the middleware's configuration for nodes of the robot that start from now on."""
        vendor = self.dds()
        # of all interfaces, the last is the launch's
        more = [dataclasses.replace(
            self._interfaces[-1],
            name=other.own.address if vendor.by_address else other.own.name)
            for other in self._joined.values()]
        peers = [other.interface.address for other in self._joined.values()] + [
            self._address(index) for name, index in self._indices.items()
            if name not in self._joined] if vendor.asks_machines else []
        write_private(self.store.launch_folder(self.id) / vendor.file_name, vendor.render(
            [*self._interfaces, *more], peers, self.user_environment, quiet=bool(more)).encode())

    def join(self, spec: MachineSpec) -> Optional[OtherVpn]:
        """
        Join the VPN of another robot's machine, before the first node that needs it; once.

        :returns: None for a machine of this launch's own.
        :raises FogError: it does not fit this launch, or cannot be joined.
        """
        provider = self.provider(spec.provider)
        with self._lock:
            if spec.name not in self._joined and (other := provider.other_vpn(spec)) is not None:
                self.undo.enter_context(provider.join(
                    spec, self.dds().rmw, self.domain, self.user_environment))
                self._joined[spec.name] = other
                if other not in self._others:
                    self._others.append(other)
                    if self._vpn is not None:
                        self._vpn.use(self._make_vpn())
                if self._robot_environment is not None:
                    self._write_interfaces()
            return self._joined.get(spec.name)

    def robot_vpn(self) -> RobotVpn:
        """Return the robot's VPN; its interface need not be up yet."""
        with self._lock:
            if self._vpn is None:
                folder = self.store.launch_folder(self.id)
                self.undo.callback(os.close, hold(folder))
                self.undo.add('VPN interface', self._clear)
                # `ros2 fog gc` reads this to recognise the folder of a killed launch
                write_private(
                    folder / 'process.json', model.to_json(this_process()).encode())
                self._vpn = RobotVpn(
                    choose_interface(
                        self.id, folder, self.user_environment, self.timeouts.vpn,
                        [other.interface.network for other in self._others]), self._make_vpn(),
                    report=self.report, timeout=self.timeouts.vpn,
                    cancel=self.cancel, ending=self._ending,
                    choose_port=functools.partial(addresses.choose_port, self.user_environment))
            return self._vpn

    def _make_vpn(self) -> Vpn:
        """Return the VPN with what the robot's filter admits now."""
        machines = [other.interface.address for other in self._others]
        vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')(
            ports=self.dds().ports, asked=[*dict.fromkeys([
                *addresses_of(self.dds().asked(self.user_environment)), *machines,
                *map(addresses.multicast_group, machines)])])
        return vpn

    def _clear(self) -> None:
        """Remove what the launch has made on the robot, as for a launch that died."""
        folder = self.store.launch_folder(self.id)
        if self._vpn is not None and self._vpn.end():
            clear(folder)
        else:
            delete_folder(folder)

    def _address(self, index: int) -> str:
        """Return the VPN address of the ``index``-th machine."""
        network = self.robot_vpn().interface.network
        return plan.machine_interface('', network, index, 0, '').address

    # -- up -------------------------------------------------------------------------------------

    def expect(self, names: Iterable[str]) -> None:
        """Reserve the VPN addresses of machines, so that nodes that start earlier know them."""
        with self._lock:
            before = len(self._indices)
            for name in names:
                self._indices.setdefault(name, len(self._indices))
            if self._robot_environment is not None and len(self._indices) > before \
                    and self.dds().asks_machines:
                self._write_interfaces()

    def context(self, spec: MachineSpec) -> Context:
        """
        Return what the steps of a machine use.

        :raises FogError: there is no such provider or middleware, or no subnet for the VPN.
        """
        def others() -> list[str]:
            with self._lock:
                return [self._address(index) for name, index in self._indices.items()
                        if name != spec.name and not {name, spec.name} & {*self._joined}]

        self.expect([spec.name])
        return Context(
            launch_id=self.id, environment=self.user_environment, store=self.store,
            report=self.report, failures=self._failures, timeouts=self.timeouts,
            cancel=self.cancel, ending=self._ending, provider=self.provider(spec.provider),
            choices=self._choices, vpn=self.robot_vpn(), dds=self.dds(),
            index=self._indices[spec.name], others=others, other_vpn=self.join(spec),
            nodes=self._nodes.get(spec.name, ()),
            shorten_others=functools.partial(self._shorten, spec.name))

    def up(self, spec: MachineSpec) -> RunningMachine:
        """
        Bring a machine up and return it; a second call for the same name waits for the first.

        Blocks until the machine is up, possibly for minutes: call it in a thread.

        :raises FogError: a step failed; its undo steps have removed the machine.
        :raises Cancelled: the launch is ending.
        """
        with self._lock:
            if self.ending or self.cancel.is_set():
                raise Cancelled(f"machine '{spec.name}'")
            known = self._ups.get(spec.name)
            if known is None:
                mine: Future[RunningMachine] = Future()
                self._ups[spec.name] = mine
        if known is not None:
            return known.result()
        try:
            machine = self._bring_up(spec)
        except BaseException as error:
            self._choices.end(spec.name)
            mine.set_exception(error)
            raise
        mine.set_result(machine)
        # others may have begun since its agent got its lifetime
        machine.shorten()
        return machine

    def _shorten(self, but: str) -> None:
        """Shorten the lifetimes of machines that are up, where features allow less now."""
        with self._lock:
            ups = [up for name, up in self._ups.items() if name != but]
        for up in ups:
            if up.done() and up.exception() is None:
                up.result().shorten()

    def retire(self, name: str) -> None:
        """
        Delete a machine for good, whatever its ``on_exit``, so that ``up`` creates it anew.

        :raises FogError: the provider has not confirmed the deletion; a later call may succeed.
        """
        with self._lock:
            up = self._ups.get(name)
        if up is not None and up.exception() is None:
            up.result().retire()
        # the next machine costs what offers cost then
        self._choices.forget(name)
        with self._lock:
            self._ups.pop(name, None)

    def _bring_up(self, spec: MachineSpec) -> RunningMachine:
        """Bring a machine up; without capacity, at the next place, as a new attempt."""
        *places, last = self._places(spec)
        for place, following in zip(places, (*places[1:], last)):
            try:
                return bring_up(self.context(place), place)
            except FogError as error:
                if not error.no_capacity or self.ending or self.cancel.is_set():
                    raise
                self.report(Warned(spec.name, f"'{spec.name}': {error.args[0]}",
                                   f'the launch tries the next offer, of {following.provider}'))
                self._choices.limited(self._check_choices(following))
        return bring_up(self.context(last), last)

    @property
    def ending(self) -> bool:
        """Whether the launch is on its way down."""
        return self._ending.is_set()

    # -- down -----------------------------------------------------------------------------------

    def down(self) -> list[FogError]:
        """
        End every machine by its ``on_exit``, then the VPN interface; idempotent.

        Call it after the robot's nodes have exited: they need the interface while they run.
        Returns the errors of undo steps that failed; the other undo steps ran.
        """
        with self._lock:
            self._ending.set()
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
            failures = [*self._failures, *known.values()]
            self._failures.clear()
        if unexpected is not None:
            for name, failure in known.items():
                # the exception below replaces the return value: report these errors here
                self.report(StepFailed(name, 'end', 0.0, str(failure), fatal=False))
            raise unexpected
        return failures


def _end(up: Future[RunningMachine]) -> None:
    """End a machine; one that is still coming up is cancelled and removes itself."""
    if up.exception() is None:
        up.result().close()
