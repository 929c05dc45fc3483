# SPDX-License-Identifier: Apache-2.0
"""
Connect a launch with its machines: one coordinator in each launch context.

Cloud processes register here as launch executes them. When launch has executed everything that
is due at that moment, the coordinator checks all new machines together, before any exists. Then
it brings them up in parallel, in threads. When launch shuts down, for whatever reason, the
coordinator keeps it alive until all processes have ended and the machines are taken down.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import copy
import functools
import os
from pathlib import Path
import threading
import time
from typing import Any, Optional, TYPE_CHECKING, Union
import weakref

from launch import Action, Event, EventHandler, LaunchContext
from launch.actions import (
    ExecuteLocal,
    OpaqueFunction,
    PopEnvironment,
    PushEnvironment,
    ResetEnvironment,
)
from launch.event_handlers import OnProcessStart, OnShutdown
from launch.events.process import ProcessStarted, ShutdownProcess
import launch.logging
from launch.substitutions import SubstitutionFailure

from fogros2 import feature, plugin_system
from fogros2.describe import defaults, values
from fogros2.describe.keywords import ROBOT
from fogros2.describe.machines import CloudInstance, unknown_machine
from fogros2.errors import Cancelled, ConfigurationError, FogError
from fogros2.feature import LaunchPart
from fogros2.launch_internals import private
from fogros2.model import NodeSpec
from fogros2.report import StepFailed
from fogros2.runtime import added_process, cost, signals
from fogros2.runtime.console import Console
from fogros2.runtime.interruption import MachineInterrupted
from fogros2.runtime.parts import Lists, Parts
from fogros2.runtime.session import Session

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.deploy import Launch
    from fogros2.describe.machines import SomeMachine
    from fogros2.describe.overrides import Overrides
    from fogros2.feature import Program
    from fogros2.model import MachineSpec, OtherVpn

#: Returns the process of a node on a machine, by the machine's name.
OnMachine = Callable[[NodeSpec, str], ExecuteLocal]

#: A machine or its name, and the package and executable of a process there, if both are known.
Planned = tuple[Optional['SomeMachine'], Optional[tuple[str, str]]]

#: The attribute of an action that has its RemoteProcess.
REMOTE = '_fogros2_remote'
#: Name of the coordinator in ``context.locals``.
_LOCAL = 'fogros2'
_EARLY = 'set it at the beginning of the launch file, outside of groups'
#: More than any launch has machines: each may block a thread.
_THREADS = 128
#: Coordinators of this process whose launches have not ended.
_ENGAGED: weakref.WeakSet[Coordinator] = weakref.WeakSet()


class Begin(Event):
    """Everything that was due has executed: the machines requested meanwhile may come up."""

    name = 'fogros2.Begin'


class Failed(Event):
    """
    The deployment failed.

    Its handler raises the error, so that ``ros2 launch`` exits with a status other than zero.
    """

    name = 'fogros2.Failed'

    def __init__(self, error: BaseException) -> None:
        super().__init__()
        self.error = error


class Coordinator:
    """
    The robot's side of a launch, on launch's event loop.

    :param make_launch: creates the deployment (a :class:`fogros2.deploy.Launch`) for the first
        machine.
    """

    def __init__(
        self, context: LaunchContext,
        make_launch: Optional[Callable[..., Launch]] = None,
    ) -> None:
        self.base_environment: dict[str, str] = {}
        #: Done when the cloud is up (True: start the robot's processes) or never will be (False).
        self.gate: Optional[asyncio.Future[bool]] = None
        self._context = context
        self._make_launch = make_launch or _make_launch
        self._launch: Optional[Launch] = None
        self._cancel = self.ended = threading.Event()
        self._console: Optional[Console] = None
        self._instances: dict[str, CloudInstance] = {}
        self._overrides: Optional[Overrides] = None
        self._mentioned: list[SomeMachine] = []
        self._whole = False
        self._sessions: dict[str, Session] = {}
        self._new: list[Session] = []
        self._deployments: list[asyncio.Task[None]] = []
        self._begun = True
        self._late: set[str] = set()
        #: What the DDS settings replaced, by variable.
        self._replaced: dict[str, Optional[str]] = {}
        #: The folder with the launch's own ``ros2``.
        self._programs: Optional[Path] = None
        #: The environment that the deployment got.
        self._users: Mapping[str, str] = {}
        self._on_machine: OnMachine
        self._dds: Optional[str] = None
        self._down: Optional[asyncio.Task[None]] = None
        #: The watches of features, which end with the launch.
        self._watches: list[asyncio.Future[None]] = []
        self._restore_signals: Callable[[], None] = lambda: None
        self._logger = launch.logging.get_logger('fogros2')
        #: What features do in the launch.
        self.parts = Parts(self)
        context.extend_globals({_LOCAL: self})
        # launch asks the handlers that were registered last first: those of launch files
        for kind, function in ((Begin, self._on_begin), (Failed, self._on_failed),
                               (MachineInterrupted, self._on_interrupted)):
            context.register_event_handler(EventHandler(
                matcher=functools.partial(_is, kind),
                entities=OpaqueFunction(function=function)))
        context.register_event_handler(OnProcessStart(on_start=self._on_process_start))
        context.register_event_handler(OnShutdown(on_shutdown=self._on_shutdown))

    @classmethod
    def of(cls, context: LaunchContext) -> Coordinator:
        """Return the context's coordinator; create it if there is none."""
        known: Optional[Coordinator] = context.get_locals_as_dict().get(_LOCAL)
        return cls(context) if known is None else known

    # -- what actions call ----------------------------------------------------------------------

    @property
    def context(self) -> LaunchContext:
        """The context in which launch runs."""
        return self._context

    @property
    def launch(self) -> Launch:
        """The deployment, which :meth:`engage` has created."""
        assert self._launch is not None
        return self._launch

    def engage(self, planned: Iterable[Planned] = ()) -> None:
        """
        Create the deployment; from now on the launch's nodes get the DDS environment.

        :param planned: what is checked before the VPN interface, which may need a password.
        :raises FogError: the environment is unavailable, as for an unknown RMW_IMPLEMENTATION; or
            this computer lacks something; or another launch of this process has machines.
        """
        if self._launch is not None:
            return
        # they would share the terminal, the signals, and the control group that the VPN filters
        if any(other._launch is not None for other in _ENGAGED):
            raise ConfigurationError('another launch of this process has machines already',
                                     'start each launch with machines in a process of its own')
        _ENGAGED.add(self)
        self._check_overrides(early=True)
        context = self._context
        defaults.check(context.environment)
        self.base_environment = _environment_at_start(context)
        self._console = Console()
        self._pool = ThreadPoolExecutor(_THREADS, 'fogros2')
        # includes what the launch file has set so far, such as ROS_DOMAIN_ID
        self._users = dict(context.environment)
        self._launch = self._make_launch(
            report=self._console, environment=self._users, cancel=self._cancel)
        self._restore_signals = signals.take_over(context)
        private.guard_shutdown(context, self._fail)
        if self._dds is not None:
            self._launch.use_dds(self._dds)
        self._check_here(planned)
        self._set_dds_environment()

    def _check_here(self, planned: Iterable[Planned]) -> None:
        """Check what is cheap; a value that cannot be resolved yet is checked later."""
        specs: dict[str, MachineSpec] = {}
        programs: dict[str, list[tuple[str, str]]] = {}
        for machine, program in planned:
            with contextlib.suppress(FogError, SubstitutionFailure):
                # its values may still change
                spec = self._spec(copy.copy(self._instance(machine or '')))
                if spec.provider == ROBOT or any(map(callable, spec.options.values())):
                    continue
                specs.setdefault(spec.name, spec)
                programs.setdefault(spec.name, []).extend([] if program is None else [program])
        with defaults.named(self._context.environment):
            self.launch.check_here(list(specs.values()), programs)

    def use_dds(self, name: str) -> None:
        """
        Select the middleware of all nodes; see :meth:`fogros2.deploy.Launch.use_dds`.

        :raises DdsError: nodes of the launch already use another one.
        """
        self._dds = name
        if self._launch is not None:
            self._launch.use_dds(name)

    def know(self, machine: Optional[SomeMachine]) -> None:
        """Remember a machine that the launch mentions, so that nodes can refer to its name."""
        if isinstance(machine, CloudInstance):
            self._instances[machine.name] = machine

    def override(
        self, overrides: Overrides, machines: Iterable[SomeMachine], *, whole: bool,
    ) -> None:
        """
        Create machines elsewhere than the launch file says.

        :param machines: the known machines of the launch; ``whole`` if there are no others.
        """
        self._overrides = overrides
        self._mentioned += machines
        self._whole = whole
        # an override without a machine is refused even if no machine is requested
        self.begin()

    def mention(self, machine: Optional[SomeMachine]) -> None:
        """Remember that the launch has a machine, even if no process requests it."""
        if machine is not None:
            self._mentioned.append(machine)

    def _check_overrides(self, *, early: bool) -> None:
        """
        Check that each override has a machine.

        :param early: check only if all machines are already known, by names that are texts.
        """
        given = [known.own_name if isinstance(known, CloudInstance) else known
                 for known in (*self._instances.values(), *self._mentioned)]
        if self._overrides is None or early and not (
                self._whole and all(isinstance(name, str) for name in given)):
            return
        self._overrides.check(
            [name for name in map(self._resolved, given) if name is not None])

    def resolve(self, machine: SomeMachine) -> Union[CloudInstance, str]:
        """Return a machine as it is, or its name resolved."""
        if isinstance(machine, CloudInstance):
            return machine
        return str(values.resolve(self._context, machine))

    def _instance(self, machine: SomeMachine) -> CloudInstance:
        machine = self.resolve(machine)
        return self._by_name(machine) if isinstance(machine, str) else machine

    def on_robot(self, machine: SomeMachine) -> bool:
        """
        Return whether a machine's processes run on the robot, because its provider is 'robot'.

        :raises ConfigurationError: a wrong value, or an unknown name.
        """
        if self._overrides is None and all(
                known.provider != ROBOT for known in self._instances.values()):
            return False
        return self._spec(self._instance(machine)).provider == ROBOT

    def engage_for(self, planned: Sequence[Planned], *, settled: bool = True) -> None:
        """
        Create the deployment if one of the machines, or an unknown name, needs a provider.

        :param settled: no later action changes the values of the machines.
        """
        if any(self._may_be_made(machine) for machine, _ in planned):
            self.engage(planned if settled else ())

    def _may_be_made(self, machine: Optional[SomeMachine]) -> bool:
        name = machine.own_name if isinstance(machine, CloudInstance) else machine
        name = self._resolved(name) or ''
        override = self._overrides.of(name) if self._overrides is not None else None
        if override is not None:
            return not override.on_robot
        if not isinstance(machine, CloudInstance):
            machine = next((known for known in self._instances.values()
                            if self._resolved(known.own_name) == name), None)
        return machine is None or machine.provider != ROBOT

    def _resolved(self, name: Optional[SomeSubstitutionsType]) -> Optional[str]:
        """Resolve a name; return None if a substitution has no value yet."""
        try:
            resolved: Optional[str] = values.resolve(self._context, name)
        except SubstitutionFailure:
            return None
        return resolved

    def _spec(self, machine: CloudInstance) -> MachineSpec:
        return defaults.resolved(machine, self._overrides, self._context)

    def session(self, machine: SomeMachine) -> Session:
        """
        Return the session of a machine; the first call for a machine schedules its creation.

        :raises ConfigurationError: a wrong value, an unknown name, or a duplicate name.
        """
        self.engage([(machine, None)])
        machine = self._instance(machine)
        spec = self._spec(machine)
        self._instances[spec.name] = machine
        session = self._sessions.get(spec.name)
        if session is None:
            makes = [made for each, own in feature.used(spec)
                     if (made := each.session(own)) is not None] or [Session]
            if len(makes) > 1:
                raise ConfigurationError(
                    f"several features want to handle the events of '{spec.name}'",
                    'pip list shows the installed packages: remove one with such a feature')
            session = makes[0](
                spec, self._context.asyncio_loop, in_thread=self._in_thread, fail=self._fail,
                changed=self._open_gate, preempted=self._preempted,
                busy=functools.partial(private.waiting_events, self._context),
                starting=functools.partial(self.parts.starting, spec.name), robot=self)
            self._sessions[spec.name] = session
            self._new.append(session)
            self.launch.expect([spec.name])
            self.launch.join(spec)
            self._set_dds_environment()
            self.begin()
        elif session.requested != spec:
            raise ConfigurationError(f"two machines of this launch have the name '{spec.name}'",
                                     'give each a name= of its own')
        session.add(machine)
        return session

    # -- what features see of the launch; :class:`fogros2.feature.RunningLaunch` ------------------

    @property
    def machines(self) -> Mapping[str, Session]:
        """The sessions by the machines' names."""
        return self._sessions

    @property
    def costs(self) -> Sequence[feature.Cost]:
        """The costs of all machines."""
        return self.launch.costs()

    @property
    def folder(self) -> Path:
        """The launch's folder on the robot."""
        return self.launch.store.launch_folder(self.launch.id)

    @property
    def interface(self) -> str:
        """The name of the robot's VPN interface."""
        return f'fog{self.launch.id}'

    @property
    def environment(self) -> Mapping[str, str]:
        """The variables of the robot's nodes."""
        return {**self._context.environment, **self.launch.robot_environment()}

    def name_of(self, machine: Optional[SomeMachine]) -> Optional[str]:
        """Return the name of a machine, None for the robot."""
        if machine is None:
            return None
        # perhaps the launch runs nothing else there
        self.know(machine)
        machine = self.resolve(machine)
        name = machine if isinstance(machine, str) else machine.spec(self._context).name
        return None if self.on_robot(name) else name

    def spec(self, name: str) -> MachineSpec:
        """Return a machine as the launch file requests it."""
        return self._spec(self._by_name(name))

    def other_vpn(self, name: str) -> Optional[OtherVpn]:
        """Return the VPN of another robot in which a machine is, None for the launch's."""
        spec = self.spec(name)
        return self.launch.provider(spec.provider).other_vpn(spec)

    def beside(
        self, own: Lists, session: Optional[Session], on_machine: OnMachine,
    ) -> list[ExecuteLocal]:
        """
        Return the processes of features that a process needs and no earlier process did.

        :param own: the resolved items of the process.
        :param session: of the process's machine, None for the robot.
        :param on_machine: returns the process of a node on a machine, by its name.
        :raises FogError: they can't run together.
        """
        self._on_machine = on_machine
        return self._processes(self.parts.beside(
            own, None if session is None or session.interrupted else session.spec.name))

    def _processes(self, programs: Iterable[Program]) -> list[ExecuteLocal]:
        return [
            self._on_machine(one.node, one.machine) if one.machine is not None
            else added_process.AddedProcess(
                one.node, self.session(one.after).came_up if one.after is not None else None)
            for one in programs]

    def begin(self) -> None:
        """Emit :class:`Begin`; launch handles it after everything that is due has executed."""
        if self._begun:
            self._begun = False
            # launch handles events after its current visit, and not if that visit fails
            self._context.emit_event_sync(Begin())

    def hold(self) -> asyncio.Future[bool]:
        """Return the gate; from now on it is closed until the cloud is up."""
        if self.gate is None:
            self.gate = self._context.asyncio_loop.create_future()
            self.begin()
        return self.gate

    # -- coming up ------------------------------------------------------------------------------

    def _by_name(self, name: str) -> CloudInstance:
        for known, instance in list(self._instances.items()):
            # a resolved name differs from the key of a name that was a substitution
            if name in (known, instance.name):
                return instance
        raise unknown_machine(name, self._instances)

    def _set_dds_environment(self) -> None:
        environment = self.launch.robot_environment()
        self._programs = self.launch.programs()
        for name in environment:
            self._replaced.setdefault(name, self.base_environment.get(name))
        if private.has_ros_node(self._context) and not (
                self.base_environment.items() >= environment.items()):
            self._warn_of_late("launch's own ROS node")
        # these are not changes of the launch file, so they must not be sent to machines
        self._replace('the launch file', environment, self._context.environment,
                      *private.kept_environments(self._context), self.base_environment)
        for action in private.processes(self._context):
            details, ended = action.process_details, private.completed(action)
            if details is None or ended is None or ended.done():
                continue
            if details['env'].items() >= environment.items():
                continue
            if details.get('pid') is None:
                # executed; starts when launch returns to its event loop
                self._replace(details['name'], environment, details['env'])
            elif details['name'] not in self._late:
                self._late.add(details['name'])
                self._warn_of_late(details['name'])

    def _replace(
        self, owner: str, settings: Mapping[str, str], *environments: MutableMapping[str, str],
    ) -> None:
        """Write the DDS settings; warn of replaced values that the deployment did not get."""
        lost = {name for environment in environments for name, value in settings.items()
                if environment.get(name) not in (
                    None, value, self._replaced[name], self._users.get(name))}
        for environment in environments:
            environment.update(settings)
            paths = environment.get('PATH', os.defpath).split(os.pathsep)
            if self._programs is not None and str(self._programs) not in paths:
                environment['PATH'] = os.pathsep.join([str(self._programs), *paths])
        if lost:
            self._logger.warning(
                f"the launch's DDS settings replace {', '.join(sorted(lost))} of {owner}, so that "
                f'it sees the cloud; {_EARLY}')

    def _warn_of_late(self, name: str) -> None:
        self._logger.warning(
            f"{name} runs already and so without the cloud's DDS settings: it "
            'may not see the cloud; use a FogROSLaunchDescription')

    def _on_process_start(self, event: ProcessStarted, context: LaunchContext) -> None:
        if self._launch is not None and self._launch.drops(event.env or {}):
            self._logger.warning(
                f"{event.process_name} has another ROS_DOMAIN_ID than the launch: the launch's "
                f'DDS filter drops messages of other domains; {_EARLY}, or start the process '
                'outside of the launch')
        others = [name for name in self._replaced
                  if (event.env or {}).get(name) != self.base_environment[name]]
        if others and REMOTE not in vars(event.action) and event.process_name not in self._late:
            self._late.add(event.process_name)
            self._logger.warning(
                f"{event.process_name} has another {', '.join(others)} than the launch: it may "
                f'not see the cloud; {_EARLY}')

    def _on_begin(self, context: LaunchContext) -> None:
        self._begun = True
        if context.is_shutdown:
            return
        self._check_overrides(early=False)
        new, self._new = self._new, []
        if new:
            task = context.asyncio_loop.create_task(self._bring_up(new))
            context.add_completion_future(task)
            task.add_done_callback(self._raise_in_launch)
            self._deployments.append(task)
        self._open_gate()

    async def _bring_up(self, sessions: list[Session]) -> None:
        try:
            await asyncio.gather(*(session.choose() for session in sessions))
            with defaults.named(self._context.environment):
                await self._in_thread(
                    self.launch.prepare, [session.spec for session in sessions],
                    {session.spec.name: session.planned for session in sessions})
        except FogError as error:
            self._fail(error)
            return
        await asyncio.gather(*(self._up(session) for session in sessions))
        if not self._watches and not self._cancel.is_set():
            self._watches = [self._in_thread(self._watch, part) for part in self.parts]

    def _watch(self, part: LaunchPart) -> None:
        begin = time.monotonic()
        try:
            part.watch()
        except Exception as error:  # noqa: BLE001 - the launch goes on without the watch
            if self._console is not None and not isinstance(error, Cancelled):
                self._console(StepFailed(
                    '', f'watch of {type(part).__module__}', time.monotonic() - begin,
                    plugin_system.cause(error), fatal=False))

    async def _up(self, session: Session) -> None:
        try:
            running = await self._in_thread(self.launch.up, session.spec)
        except FogError as error:
            # end the launch at once, although other machines are still coming up
            self._fail(error)
            return
        session.up(running)

    def _raise_in_launch(self, task: asyncio.Task[None]) -> None:
        # ``exception()`` of a cancelled task raises
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self._fail(error)

    def _open_gate(self) -> None:
        if self.gate is None or self.gate.done() or not self._begun:
            return
        if not self._new and all(session.ready for session in self._sessions.values()):
            self.gate.set_result(True)

    # -- a machine is lost ----------------------------------------------------------------------

    def _preempted(self, session: Session, reason: str) -> None:
        if not self._context.is_shutdown:
            self._context.emit_event_sync(
                MachineInterrupted(session.spec.name, reason, session.lost))

    def _on_interrupted(self, context: LaunchContext) -> list[Action]:
        event = context.locals.event
        session = self._sessions.get(event.machine)
        if session is None or context.is_shutdown:
            return []
        return session.go_on(event)

    def take_over(self, machine: str) -> list[Action]:
        """Let features use the robot in a machine's place; return the processes that they need."""
        processes: list[Action] = []
        for part in self.parts:
            ended, programs = part.moved(machine)
            for node in ended:
                self._context.emit_event_sync(
                    ShutdownProcess(process_matcher=functools.partial(_runs, node)))
            processes += self._processes(programs)
        return processes

    # -- going down -----------------------------------------------------------------------------

    def _fail(self, error: BaseException) -> None:
        if isinstance(error, Cancelled):
            return  # the shutdown of the launch has caused it
        self._context.emit_event_sync(Failed(error))

    def _on_failed(self, context: LaunchContext) -> None:
        raise context.locals.event.error

    def _on_shutdown(self, event: Event, context: LaunchContext) -> None:
        if self._down is not None:
            return
        self._cancel.set()
        if self.gate is not None and not self.gate.done():
            self.gate.set_result(False)
        for session in self._sessions.values():
            session.give_up()
        if self._launch is None:
            return
        self._down = context.asyncio_loop.create_task(self._take_down())
        self._down.add_done_callback(self._taken_down)
        context.add_completion_future(self._down)

    async def _take_down(self) -> None:
        # the VPN interface must stay while a node runs
        sessions = self._sessions.values()
        futures = [private.completed(action) for action in private.processes(self._context)]
        await _all_done({*futures, *self._deployments, *self._watches})
        await _all_done({request for session in sessions for request in session.requests})
        for error in await self._in_thread(self.launch.down):
            self._fail(error)
        for line in cost.lines(self.costs):
            self._logger.info(line)

    def _taken_down(self, task: asyncio.Task[None]) -> None:
        _ENGAGED.discard(self)
        self._restore_environment()
        self._raise_in_launch(task)
        if self._console is not None:
            self._console.close()
        self._pool.shutdown(wait=False)
        self._restore_signals()

    def _restore_environment(self) -> None:
        """Undo the DDS settings: they name deleted files, and this process may launch again."""
        environment = self._context.environment
        for name, value in self._replaced.items():
            if environment.get(name) != self.base_environment[name]:
                continue  # set anew by something else
            if value is None:
                del environment[name]
            else:
                environment[name] = value
        if self._programs is not None:
            environment['PATH'] = os.pathsep.join(
                path for path in environment.get('PATH', '').split(os.pathsep)
                if path != str(self._programs))

    def _in_thread(self, function: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:
        future: asyncio.Future[Any] = self._context.asyncio_loop.run_in_executor(
            self._pool, function, *args)
        return future


async def _all_done(futures: set[Optional[asyncio.Future[Any]]]) -> None:
    waits = {future for future in futures if future is not None}
    if waits:
        await asyncio.wait(waits)


def _is(kind: type[Event], event: Event) -> bool:
    return isinstance(event, kind)


def _runs(node: str, action: ExecuteLocal) -> bool:
    return isinstance(action, added_process.AddedProcess) and action.node == node


def _make_launch(**arguments: Any) -> Launch:
    # imported for the first machine: it imports the SSH shell
    from fogros2.deploy import Launch
    return Launch(**arguments)


def _environment_at_start(context: LaunchContext) -> dict[str, str]:
    """Return the environment in which the launch was started, as ResetEnvironment restores it."""
    PushEnvironment().execute(context)
    ResetEnvironment().execute(context)
    environment = dict(context.environment)
    PopEnvironment().execute(context)
    return environment
