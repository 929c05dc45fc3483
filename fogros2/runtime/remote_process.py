# SPDX-License-Identifier: Apache-2.0
"""Process actions of launch whose processes run on a machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import functools
from typing import Any, cast, Optional, TYPE_CHECKING

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteLocal

from fogros2 import feature, plan
from fogros2.errors import ConfigurationError
from fogros2.launch_internals import components, private
from fogros2.model import NodeSpec
from fogros2.runtime import node_spec
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.coordinator import Coordinator, Planned, REMOTE
from fogros2.runtime.remote_run import RemoteRun

if TYPE_CHECKING:
    from fogros2.describe.machines import SomeMachine
    from fogros2.runtime.parts import Lists
    from fogros2.runtime.session import Session

#: The attribute of an action whose process no CloudGroup sends.
_KEPT = '_fogros2_kept'


class RemoteProcess:
    """
    What makes the process of an action run on a machine, in place of here.

    The action stays the same object, so handlers that have it as their target still match; launch
    calls this object's methods instead of four of its own.

    :param own: the process's items of features' lists, resolved.
    """

    #: Whether it may run in a container, see :attr:`fogros2.feature.Feature.containers`.
    contained = False
    #: The values of features' keywords, by feature.
    features: Mapping[str, Mapping[str, Any]] = {}
    #: Of the action's machine; set by ``prepare`` unless the process runs on the robot.
    session: Optional[Session] = None
    #: Whether the launch does not go on without the process.
    needed = True
    #: Whether the process runs on the robot.
    here = False
    _node: NodeSpec
    #: The command on the robot, if the process may move there.
    _command: Optional[list[str]] = None
    #: Whether launch has reached the point at which it starts a local process.
    _began = False
    _stay: Optional[private.Stay] = None

    def __init__(
        self, action: ExecuteLocal, machine: SomeMachine, own: Lists,
    ) -> None:
        self.action = action
        self.machine = machine
        self.own = own
        self._own = private.replace_methods(action, private.Methods(
            self.execute, self.prepare, self.start, self.shut_down))
        vars(action)[REMOTE] = self

    @property
    def lists(self) -> Lists:
        """The action's items of features' lists, as the launch file gives them."""
        return getattr(self.action, 'lists', {})

    @property
    def planned(self) -> Planned:
        """The machine, and the program if nothing can change it."""
        return self.machine, None if self.contained else node_spec.program_of(self.action)

    def prepare(self, context: LaunchContext) -> None:
        """Resolve the action, as ExecuteLocal does, and create its NodeSpec."""
        action, coordinator = self.action, Coordinator.of(context)
        if coordinator.on_robot(self.machine):
            self.here = True
            self._own.prepare(context)
            for keyword, value in feature.contained(self.features).items():
                raise ConfigurationError(
                    f"the {keyword} '{value}' is for a machine, and the robot runs this node "
                    'itself', f'leave {keyword}= out for the robot, or choose another machine')
            return
        self.session = session = coordinator.session(self.machine)
        node_spec.use_names_of_programs(action)
        self._own.prepare(context)
        contained = feature.contained(self.features)
        private.prefix_output(action, session.spec.name)
        provider = coordinator.launch.provider(session.spec.provider)
        self._node = dataclasses.replace(node_spec.from_action(
            action, context, coordinator.base_environment, session.spec, coordinator.launch.id,
            bool(contained), provider.has_own_packages(session.spec),
            provider.capabilities.account), features=self.features)
        if not isinstance(action, AddedProcess):
            if self.needed:
                session.need(self._node.name)
            _warn_of_paths(coordinator, session, self._node, plan.ament_prefixes(
                coordinator.base_environment) if contained else ())
        for each, own in feature.used(session.spec):
            each.check_node(session.spec, self._node, own)
        if not (contained or isinstance(action, AddedProcess)):
            self._command = session.command_here(
                functools.partial(node_spec.robot_command, action, context))

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action; its process starts when its machine is up."""
        if context.is_shutdown:
            return None
        coordinator = Coordinator.of(context)
        folder = files = None
        if not coordinator.on_robot(self.machine):
            # before the action executes: launch_ros's actions do much before they prepare
            coordinator.engage([self.planned])
            # some of them create a ROS node here, which needs the launch's DDS settings
            folder = coordinator.session(self.machine).spec.workspace
            files = coordinator.folder
        with node_spec.packages_of(folder, files):
            entities = self._own.execute(context) or []
        if self.session is None:
            return [*entities, *coordinator.beside(self.own, None, process_on)]
        run = RemoteRun(
            self.action, context, self.session, self._node,
            self._come_here if self._command is not None else None, self._go_back)
        private.set_transport(self.action, run)
        self.session.submit(run)
        beside = [] if isinstance(self.action, AddedProcess) else coordinator.beside(
            self.own, self.session, process_on)
        return [*entities, *beside, *self._helpers(coordinator, self.session)]

    def _helpers(
        self, coordinator: Coordinator, session: Session,
    ) -> list[LaunchDescriptionEntity]:
        """Return features' programs of a machine, with its first process."""
        if session.has_helpers or session.interrupted:
            return []
        session.has_helpers = True
        name = session.spec.name
        return [process_on(one, name) if isinstance(one, NodeSpec) else one
                for each, own in feature.used(session.spec)
                for one in each.beside(session.spec, own)]

    def _come_here(self, context: LaunchContext) -> None:
        """Start the process on the robot, as launch does; its machine no longer runs it."""
        action = self.action
        assert action.process_details is not None and self._command is not None and self.session
        self.here = True
        self._stay = private.Stay(action, context)
        action.process_details.pop('pid', None)
        action.process_details['cmd'] = self._command
        private.prefix_output(action, self.session.spec.name, remove=True)
        private.set_transport(action, None)
        if self._began:
            context.asyncio_loop.create_task(self.start(context))

    async def _go_back(self, run: RemoteRun) -> None:
        """End the process on the robot; ``run`` follows it on its machine from now on."""
        assert self._stay is not None and self.session is not None
        await self._stay.leave(run.node.sigterm_timeout, run.node.sigkill_timeout)
        self.here = False
        private.prefix_output(self.action, self.session.spec.name)
        private.set_transport(self.action, run)

    async def start(self, context: LaunchContext) -> None:
        """Do nothing if the process runs remotely: the session starts it and passes events."""
        self._began = True
        if self.here:
            await self._own.start(cast(LaunchContext, self._stay or context))

    def shut_down(
        self, context: LaunchContext, *, send_sigint: bool,
    ) -> Optional[list[LaunchDescriptionEntity]]:
        """Request the end from the machine, if the process runs there."""
        if self.here:
            return self._own.shut_down(context, send_sigint=send_sigint)
        # launch expects the terminal to send SIGINT to local nodes; a machine needs a request. The
        # machine escalates to SIGTERM and SIGKILL by itself, even if the connection is lost
        run: Optional[RemoteRun] = private.transport(self.action)
        if run is not None:
            run.on('stop')
        return None


def send(
    action: ExecuteLocal, machine: SomeMachine, own: Optional[Lists] = None,
) -> RemoteProcess:
    """
    Make the process of an action that has not been executed run on ``machine``.

    :param own: the process's items of features' lists, resolved.
    """
    return RemoteProcess(action, machine, own or {})


def remote_of(entity: object) -> Optional[RemoteProcess]:
    """Return what makes the process of an action run on a machine, None for all else."""
    remote: Optional[RemoteProcess] = getattr(entity, REMOTE, None)
    return remote


def keep(action: ExecuteLocal) -> None:
    """Keep the process of an action on the robot, also in a CloudGroup."""
    vars(action)[_KEPT] = True


def stays(action: ExecuteLocal) -> bool:
    """Return whether a CloudGroup must not send the process of an action."""
    return isinstance(action, AddedProcess) or _KEPT in vars(action)


def process_on(spec: NodeSpec, machine: str) -> ExecuteLocal:
    """Return a process that FogROS2 adds on a machine."""
    process = AddedProcess(spec)
    send(process, machine)
    return process


def send_components(
    entity: LaunchDescriptionEntity, machine: SomeMachine, own: Lists, context: LaunchContext,
) -> None:
    """
    Make the components that an entity loads on a machine use the topic names there.

    :param entity: changed only if it loads components, and only once.
    :param own: its items of features' lists, resolved.
    """
    if not (isinstance(entity, Action) and components.are_loaded_by(entity)) or (
            components.have_names(entity)):  # an inner group's, or of an earlier visit
        return
    coordinator = Coordinator.of(context)
    session = None if coordinator.on_robot(machine) else coordinator.session(machine)

    def beside() -> list[ExecuteLocal]:
        if session is not None:
            for name, texts in components.parameters(entity, context):
                _warn_of_paths(coordinator, session, NodeSpec('', name, arguments=tuple(texts)))
        return coordinator.beside(own, session, process_on)

    components.rename_topics(
        entity, lambda: {} if session is None or session.interrupted else coordinator.parts.names(
            session.spec.name), beside)


def _warn_of_paths(
    coordinator: Coordinator, session: Session, node: NodeSpec, more: Sequence[str] = (),
) -> None:
    """
    Warn of paths of the robot that a node gets, which its machine may not have.

    :param more: folders beside the home folder.
    """
    home = coordinator.context.environment.get('HOME', '')
    paths = node_spec.robot_paths(node, [home, *more], session.spec.workspaces)
    shared = coordinator.launch.provider(session.spec.provider).shared_folders(
        session.spec) if paths else ()
    session.warn_of_paths(node, [path for path in paths if not plan.below(path, shared)])
