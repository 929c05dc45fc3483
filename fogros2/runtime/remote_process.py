# SPDX-License-Identifier: Apache-2.0
"""Process actions of launch whose processes run on a machine."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import json
from typing import Any, cast, Optional, TYPE_CHECKING

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteLocal

from fogros2 import plan
from fogros2.errors import ConfigurationError
from fogros2.host.checkpoint import check_folder
from fogros2.launch_internals import components, private
from fogros2.model import NodeSpec
from fogros2.runtime import foxglove, node_spec
from fogros2.runtime.coordinator import Coordinator, Planned
from fogros2.runtime.remote_run import RemoteRun
from fogros2.runtime.republishers import AddedProcess

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import SomeMachine
    from fogros2.image_transport.streams import StreamTopic
    from fogros2.runtime.session import Session


class RemoteProcess(private.RemoteStart):
    """
    A process action whose process runs on a machine.

    :func:`send` makes it the second base of a class: the method resolution order of
    ``class Away(Node, RemoteProcess)`` puts it between Node and ExecuteLocal. It keeps the
    execution of ExecuteLocal except the start of the process.
    """

    _fogros2_machine: SomeMachine
    _fogros2_streams: Sequence[StreamTopic] = ()
    _image: Optional[SomeSubstitutionsType] = None
    #: Container image that the process runs in, and more options for its ``docker run``.
    _fogros2_image = ''
    _fogros2_image_options: Sequence[str] = ()
    _fogros2_session: Session
    _fogros2_node: NodeSpec
    #: The command on the robot, if ``on_interrupt`` may move the process there.
    _fogros2_command: Optional[list[str]] = None
    #: Whether the process runs on the robot, for example after a preemption.
    _fogros2_here = False
    #: Whether launch has reached the point at which it starts a local process.
    _fogros2_began = False
    _fogros2_stay: Optional[private.Stay] = None

    @property
    def machine(self) -> SomeMachine:
        """The machine that the process runs on, or its name."""
        return self._fogros2_machine

    @property
    def planned(self) -> Planned:
        """The machine, and the program if nothing can change it."""
        # only its machine knows what is in an image
        return self.machine, None if self._image is not None else node_spec.program_of(self)

    def prepare(self, context: LaunchContext) -> None:
        """Resolve the action, as ExecuteLocal does, and create its NodeSpec."""
        coordinator = Coordinator.of(context)
        if coordinator.on_robot(self._fogros2_machine):
            self._fogros2_here = True
            super().prepare(context)
            return
        self._fogros2_session = session = coordinator.session(self._fogros2_machine)
        node_spec.use_names_of_programs(self)
        super().prepare(context)
        private.prefix_output(self, session.spec.name)
        provider = coordinator.launch.provider(session.spec.provider)
        self._fogros2_node = node_spec.from_action(
            self, context, coordinator.base_environment, session.spec, coordinator.launch.id,
            self._fogros2_image, self._fogros2_image_options,
            provider.has_own_packages(session.spec), bool(provider.invitation(session.spec)))
        if not isinstance(self, AddedProcess):
            paths = node_spec.robot_paths(
                self._fogros2_node, [context.environment.get('HOME', ''), *(plan.ament_prefixes(
                    coordinator.base_environment) if self._fogros2_image else ())],
                session.spec.workspaces)
            shared = provider.shared_folders(session.spec) if paths else ()
            session.warn_of_paths(
                self._fogros2_node, [path for path in paths if not plan.below(path, shared)])
        if session.spec.idle_timeout is not None and (
                self._fogros2_image or session.spec.containers):
            raise ConfigurationError(
                f"the machine '{session.spec.name}' has an idle_timeout and runs a container: "
                'nothing measures what a container computes',
                'leave idle_timeout= out, or run the nodes without containers')
        how = session.spec.on_interrupt
        if how != 'shutdown' and not session.replicated and not (
                self._fogros2_image or isinstance(self, AddedProcess)):
            # until a replacement is up, only some nodes may be able to run on the robot
            with contextlib.suppress(*([ConfigurationError] if how == 'replace' else [])):
                self._fogros2_command = node_spec.robot_command(self, context)

    def add_checkpoint(self, folder: Optional[str]) -> None:
        """
        Add a folder of the process to the checkpoints of its machine.

        :raises ConfigurationError: no such folder, or the machine is not replaced.
        """
        if not folder or self._fogros2_here:
            return
        session = self._fogros2_session
        if session.checkpoints is None:
            raise ConfigurationError(
                f"a node of '{session.spec.name}' has a checkpoint, and nothing would restore it",
                "add on_interrupt='replace' to the machine, or leave checkpoint= out")
        session.checkpoints.add(check_folder('checkpoint', folder))

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action; its process starts when its machine is up."""
        if context.is_shutdown:
            return None
        entities = super().execute(context)
        if self._fogros2_here:
            return [*(entities or ()), *_streams_to_robot(
                self._fogros2_streams, Coordinator.of(context))]
        run = RemoteRun(
            self, context, self._fogros2_session, self._fogros2_node,
            self._come_here if self._fogros2_command is not None else None, self._go_back)
        private.set_transport(self, run)
        self._fogros2_session.submit(run)
        return [*(entities or ()), *self._republishers(context), *self._helpers(context)]

    def _republishers(self, context: LaunchContext) -> list[ExecuteLocal]:
        """Return the republishers of this process's streams that no earlier process needed."""
        if isinstance(self, AddedProcess):
            return []
        return _streams_to_machine(
            self._fogros2_streams, Coordinator.of(context), self._fogros2_session)

    def _helpers(self, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        """Return the machine's containers, relay and Foxglove bridge, with its first process."""
        session = self._fogros2_session
        if session.has_helpers or session.interrupted:
            return []
        session.has_helpers = True
        coordinator = Coordinator.of(context)
        name = session.spec.name
        helpers: list[LaunchDescriptionEntity] = []
        for number, line in enumerate(session.spec.containers):
            from fogros2.host import containers
            helpers.append(process_on(containers.follow(
                containers.parse(line), number, coordinator.launch.id), name))
        if session.spec.share:
            folders = coordinator.launch.provider(
                session.spec.provider).capabilities.share_folders
            helpers.append(process_on(NodeSpec(
                id=f'share-{name}', name='share', package='fogros2', executable='share',
                respawn=True, respawn_delay=1.0, arguments=(json.dumps({
                    'topics': session.spec.share, 'folders': folders}),)), name))
        if session.spec.monitored:
            bridge, started = foxglove.on_machine(
                coordinator, session, allow=session.spec.monitor_allow)
            send(bridge, name)
            helpers += [bridge, started]
        return helpers

    def _come_here(self, context: LaunchContext) -> None:
        """Start the process on the robot, as launch does; its machine no longer runs it."""
        assert self.process_details is not None and self._fogros2_command is not None
        self._fogros2_here = True
        self._fogros2_stay = private.Stay(self, context)
        self.process_details.pop('pid', None)
        self.process_details['cmd'] = self._fogros2_command
        private.prefix_output(self, self._fogros2_session.spec.name, remove=True)
        private.set_transport(self, None)
        if self._fogros2_began:
            context.asyncio_loop.create_task(self.fogros2_start(context))

    async def _go_back(self, run: RemoteRun) -> None:
        """End the process on the robot; ``run`` follows it on its machine from now on."""
        assert self._fogros2_stay is not None
        await self._fogros2_stay.leave(run.node.sigterm_timeout, run.node.sigkill_timeout)
        self._fogros2_here = False
        private.prefix_output(self, self._fogros2_session.spec.name)
        private.set_transport(self, run)

    async def fogros2_start(self, context: LaunchContext) -> None:
        """Do nothing if the process runs remotely: the session starts it and passes events."""
        self._fogros2_began = True
        if self._fogros2_here:
            await super().fogros2_start(cast(LaunchContext, self._fogros2_stay or context))

    def fogros2_shut_down(
        self, context: LaunchContext, send_sigint: bool,
    ) -> Optional[list[LaunchDescriptionEntity]]:
        """Request the end from the machine, if the process runs there."""
        if self._fogros2_here:
            return super().fogros2_shut_down(context, send_sigint)
        # launch expects the terminal to send SIGINT to local nodes; a machine needs a request. The
        # machine escalates to SIGTERM and SIGKILL by itself, even if the connection is lost
        run: Optional[RemoteRun] = private.transport(self)
        if run is not None:
            run.on('stop')
        return None


def send(
    action: ExecuteLocal, machine: SomeMachine, streams: Sequence[StreamTopic] = (),
) -> None:
    """
    Turn an action that has not been executed into one whose process runs on ``machine``.

    The object stays the same, so handlers that have it as their target still match.

    :param streams: topics to stream between the robot and the machine, resolved.
    :raises ConfigurationError: launch cannot run this kind of action on a machine.
    """
    try:
        action.__class__ = _remote_class(type(action))
    except TypeError as error:
        raise ConfigurationError(
            f"{type(action).__name__} can't run on a machine: {error}",
            'take it out of the CloudGroup') from error
    assert isinstance(action, RemoteProcess)
    action._fogros2_machine = machine
    action._fogros2_streams = streams


def process_on(spec: NodeSpec, machine: str) -> ExecuteLocal:
    """Return a process that FogROS2 adds on a machine."""
    process = AddedProcess(spec)
    send(process, machine)
    return process


def send_components(
    entity: LaunchDescriptionEntity, machine: SomeMachine, streams: Sequence[StreamTopic],
    context: LaunchContext,
) -> None:
    """
    Make the components that an entity loads on a machine use the machine's streams.

    :param entity: changed only if it loads components.
    """
    if not (isinstance(entity, Action) and components.are_loaded_by(entity)):
        return
    coordinator = Coordinator.of(context)
    if coordinator.on_robot(machine):
        components.rename_topics(
            entity, dict, lambda: _streams_to_robot(streams, coordinator))
    else:
        session = coordinator.session(machine)
        components.rename_topics(
            entity, session.names_for_components,
            lambda: _streams_to_machine(streams, coordinator, session))


def _streams_to_machine(
    streams: Sequence[StreamTopic], coordinator: Coordinator, session: Session,
) -> list[ExecuteLocal]:
    """Return the republishers that a process on a machine needs and no earlier one needed."""
    if session.interrupted:
        return _streams_to_robot(streams, coordinator)
    return coordinator.stream(streams, session, process_on)


def _streams_to_robot(
    streams: Sequence[StreamTopic], coordinator: Coordinator,
) -> list[ExecuteLocal]:
    """Return the republishers that bring other machines' topics to a process on the robot."""
    actions: list[ExecuteLocal] = []
    for entry in streams:
        if entry.source is not None:
            actions += coordinator.stream(
                [entry.but(direction='to_robot', source=None)],
                coordinator.session(entry.source), process_on)
    return actions


_remote_classes: dict[type[ExecuteLocal], type[RemoteProcess]] = {}


def _remote_class(cls: type[ExecuteLocal]) -> type[RemoteProcess]:
    if cls not in _remote_classes:
        # ExecuteLocal cannot precede its subclass in the bases
        bases = (RemoteProcess,) if cls is ExecuteLocal else (cls, RemoteProcess)
        remote: type[RemoteProcess] = type(cls.__name__, bases, {
            '__module__': cls.__module__, '__doc__': cls.__doc__,
            'execute': lambda action, context: _execute(super(remote, action), action, context)})
        _remote_classes[cls] = remote
    return _remote_classes[cls]


def _execute(
    parent: Any, action: RemoteProcess, context: LaunchContext,
) -> Optional[list[LaunchDescriptionEntity]]:
    """Register the machine before execution: launch_ros's actions do much before ``prepare``."""
    folder = None
    coordinator = Coordinator.of(context)
    if not context.is_shutdown and not coordinator.on_robot(action.machine):
        coordinator.engage([action.planned])
        # some actions create a ROS node in this process, which needs the launch's DDS settings
        folder = coordinator.session(action.machine).spec.workspace
    with node_spec.packages_of(folder):
        entities: Optional[list[LaunchDescriptionEntity]] = parent.execute(context)
    return entities
