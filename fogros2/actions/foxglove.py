# SPDX-License-Identifier: Apache-2.0
"""Foxglove: a machine's topics in a browser."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, TYPE_CHECKING, Union

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessStart
import launch.logging

from fogros2.actions import words
from fogros2.actions.carriers import Carrier
from fogros2.actions.coordinator import Coordinator
from fogros2.actions.remote import send
from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec
from fogros2.monitor import urls

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.actions.coordinator import SomeMachine
    from fogros2.actions.session import Session

#: Seconds before a bridge that ended is started again.
_RESPAWN = 2.0


class Foxglove(Action):
    """
    Serves the topics that a machine sees to Foxglove, or Lichtblick, in a browser.

    The bridge listens on the machine's loopback and in the VPN: the robot gets there, and whoever
    may enter the machine, by ``ros2 fog monitor``. A machine that turns out to be the robot itself
    serves on its loopback alone.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param topics: patterns (``*``, ``?``) of the topics to show.
    :param port: TCP port.
    :raises ConfigurationError: no port, or no pattern.
    """

    def __init__(
        self, machine: SomeMachine, topics: Sequence[SomeSubstitutionsType] = ('*',),
        port: Union[int, SomeSubstitutionsType] = urls.PORT, **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if isinstance(topics, str) or not topics:
            raise ConfigurationError(
                f'topics={topics!r} is no list of patterns', "such as ['/camera/*', '/tf']")
        self.machine = machine
        self._topics = list(topics)
        self._port = port
        if isinstance(port, (int, str)):
            _port(port)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Start the bridge as soon as the machine is up, and say where it is once it runs."""
        coordinator = Coordinator.of(context)
        port = _port(words.resolve(context, self._port))
        topics = [words.resolve(context, topic) for topic in self._topics]
        session = None
        if not coordinator.on_robot(self.machine):
            session = coordinator.session(self.machine)
        process = Carrier(_bridge(session, port, topics))
        if session is not None:
            send(process, session.spec.name)
        return [process, RegisterEventHandler(OnProcessStart(
            target_action=process,
            on_start=OpaqueFunction(function=lambda _: _tell(session, port))))]


def _port(value: Union[int, str]) -> int:
    try:
        port = int(value)
    except ValueError:
        port = 0
    if not 0 < port < 65536:
        raise ConfigurationError(f'port={value!r} is no TCP port', f'use 1 to 65535, such as '
                                 f'{urls.PORT}')
    return port


def _bridge(session: Optional[Session], port: int, topics: Sequence[str]) -> NodeSpec:
    where = 'robot' if session is None else session.spec.name
    vpn = () if session is None else ('--vpn', str(port))
    return NodeSpec(
        id=f'foxglove-{where}-{port}', name='foxglove_bridge', package='fogros2',
        executable='bridge', respawn=True, respawn_delay=_RESPAWN,
        arguments=('--listen', f'127.0.0.1:{port}', *vpn,
                   *(word for topic in topics for word in ('--topic', topic))))


def _tell(session: Optional[Session], port: int) -> None:
    logger = launch.logging.get_logger('fogros2')
    if session is None or session.running is None:
        logger.info(f"Foxglove: {urls.app(urls.bridge('localhost', port))}")
        return
    session.running.serves(port)
    name = session.spec.name
    logger.info(
        f'{name}: Foxglove at {urls.bridge(session.running.vpn_address, port)}; '
        f'in a browser: ros2 fog monitor {name}')
