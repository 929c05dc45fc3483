# SPDX-License-Identifier: Apache-2.0
"""Process actions of launch whose processes run on a machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, TYPE_CHECKING

from launch import LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteLocal
from launch.event_handlers import OnProcessIO

from fogros2.actions import carriers, node_spec, private, streaming
from fogros2.actions.coordinator import Coordinator
from fogros2.actions.remote_run import RemoteRun
from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec

if TYPE_CHECKING:
    from fogros2.actions.coordinator import SomeMachine
    from fogros2.actions.session import Session
    from fogros2.image_transport.streams import Entry


class RemoteProcess(ExecuteLocal):
    """
    A process action whose process runs on a machine.

    :func:`send` makes it the second base of a class: the method resolution order of
    ``class Away(Node, RemoteProcess)`` puts it between Node and ExecuteLocal. It keeps the
    execution of ExecuteLocal except the start of the process.
    """

    _fogros2_machine: SomeMachine
    _fogros2_streams: Sequence[Entry] = ()
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

    @property
    def machine(self) -> SomeMachine:
        """The machine that the process runs on, or its name."""
        return self._fogros2_machine

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
        self._fogros2_node = node_spec.from_action(
            self, context, coordinator.base_environment, session.spec, coordinator.launch.id,
            self._fogros2_image, self._fogros2_image_options)
        if session.spec.on_interrupt == 'robot' and not (
                self._fogros2_image or isinstance(self, carriers.Carrier)):
            self._fogros2_command = node_spec.robot_command(self, context)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action; its process starts when its machine is up."""
        if context.is_shutdown:
            return None
        entities = super().execute(context)
        if self._fogros2_here:
            return [*(entities or ()), *carriers_here(self._fogros2_streams, context)]
        future = private.completed(self)
        assert future is not None
        run = RemoteRun(self, context, self._fogros2_session, self._fogros2_node, future)
        private.set_transport(self, run)
        context.register_event_handler(OnProcessIO(target_action=self, on_stdin=run.on_stdin))
        self._fogros2_session.submit(run)
        return [*(entities or ()), *self._carriers(context), *self._beside(context)]

    def _carriers(self, context: LaunchContext) -> list[ExecuteLocal]:
        """Return the republishers of this process's streams that no earlier process needed."""
        if isinstance(self, carriers.Carrier):
            return []
        return carriers_of(self._fogros2_streams, context, self._fogros2_session)

    def _beside(self, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        """Return what the machine runs beside its nodes, when its first process executes."""
        session = self._fogros2_session
        if session.furnished or session.interrupted:
            return []
        session.furnished = True
        found: list[LaunchDescriptionEntity] = []
        for number, line in enumerate(session.spec.containers):
            from fogros2 import containers
            follower = carriers.Carrier(containers.follow(
                containers.parse(line), number, Coordinator.of(context).launch.id))
            send(follower, session.spec.name)
            found.append(follower)
        if session.spec.monitored:
            from fogros2.actions.foxglove import Foxglove
            found.append(Foxglove(
                session.spec.name, monitor_allow=session.spec.monitor_allow))
        return found

    @property
    def can_come_here(self) -> bool:
        """Whether the process can continue on the robot."""
        return self._fogros2_command is not None

    def come_here(self, context: LaunchContext) -> None:
        """Start the process on the robot, as launch does; its machine no longer runs it."""
        assert self.process_details is not None and self._fogros2_command is not None
        self._fogros2_here = True
        self.process_details.pop('pid', None)
        self.process_details['cmd'] = self._fogros2_command
        private.unprefix_output(self, self._fogros2_session.spec.name)
        private.set_transport(self, None)
        if self._fogros2_began:
            context.asyncio_loop.create_task(private.execute_process(self)(context))

    async def _ExecuteLocal__execute_process(self, context: LaunchContext) -> None:
        """Do nothing if the process runs remotely: the session starts it and passes events."""
        self._fogros2_began = True
        if self._fogros2_here:
            await getattr(super(), private.EXECUTE_PROCESS)(context)

    def _shutdown_process(
        self, context: LaunchContext, *, send_sigint: bool,
    ) -> Optional[list[LaunchDescriptionEntity]]:
        if self._fogros2_here:
            return super()._shutdown_process(context, send_sigint=send_sigint)
        # launch expects the terminal to send SIGINT to local nodes; a machine needs a request. The
        # machine escalates to SIGTERM and SIGKILL by itself, even if the connection is lost
        run: Optional[RemoteRun] = private.transport(self)
        if run is not None:
            run.stop()
        return None


def send(
    action: ExecuteLocal, machine: SomeMachine, streams: Sequence[Entry] = (),
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


def carriers_of(
    streams: Sequence[Entry], context: LaunchContext, session: Session,
) -> list[ExecuteLocal]:
    """Return the republishers that a process on a machine needs and no earlier one needed."""
    if session.interrupted:
        return carriers_here(streams, context)
    return _carriers_to(streams, context, session)


def carriers_here(streams: Sequence[Entry], context: LaunchContext) -> list[ExecuteLocal]:
    """Return the republishers that bring other machines' topics to a process on the robot."""
    coordinator = Coordinator.of(context)
    found: list[ExecuteLocal] = []
    for entry in streams:
        if isinstance(entry, tuple) or entry.source is None:
            continue
        found += _carriers_to(
            [streaming.to_robot(entry)], context, coordinator.session(entry.source))
    return found


def _carriers_to(
    streams: Sequence[Entry], context: LaunchContext, session: Session,
) -> list[ExecuteLocal]:
    return [
        carriers.RobotCarrier(spec, session.came_up) if machine is None else
        carrier_on(spec, machine)
        for machine, spec in Coordinator.of(context).stream(streams, session)]


def carrier_on(spec: NodeSpec, machine: str) -> ExecuteLocal:
    """Return the republisher of a stream on a machine."""
    carrier = carriers.Carrier(spec)
    send(carrier, machine)
    return carrier


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
        # some actions create a ROS node in this process, which needs the launch's DDS settings
        folder = coordinator.session(action.machine).spec.workspace
    with node_spec.packages_of(folder):
        entities: Optional[list[LaunchDescriptionEntity]] = parent.execute(context)
    return entities
