# SPDX-License-Identifier: Apache-2.0
"""Foxglove: show the topics of a machine in a browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import logging
import os
import shutil
from typing import Any, Optional, TYPE_CHECKING, Union

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessStart, OnShutdown
import launch.logging

from fogros2 import monitor_addresses as addresses
from fogros2 import plugin_system
from fogros2.actions import networks, words
from fogros2.actions.carriers import Carrier
from fogros2.actions.coordinator import Coordinator
from fogros2.actions.remote import send
from fogros2.errors import ConfigurationError, Unsupported
from fogros2.model import NodeSpec
from fogros2.store import Store

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.actions.coordinator import SomeMachine
    from fogros2.actions.session import Session

#: Seconds before a bridge that ended is started again.
_RESPAWN = 2.0
#: The agent's folder, as a process on the machine sees it.
_AGENT = '$FOGROS2_AGENT_DIRECTORY'


class Foxglove(Action):
    """
    Serve the topics that a machine sees to Foxglove or Lichtblick in a browser.

    The bridge listens on the machine's loopback interface and in the VPN, and admits clients with
    its token. ``ros2 fog monitor`` prints the token, on the robot and for users who may log in to
    the machine. If the machine is the robot itself, the bridge listens on its loopback only.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param topics: patterns (``*``, ``?``) of the topics to show.
    :param port: TCP port; the next two ports serve external clients and the web application.
    :param monitor_allow: networks (CIDR) of external clients, which connect to the port after
        that one by TLS and with the token. The launch opens the port in the provider's firewall,
        if there is one. The machine itself refuses other addresses.
    :param image: container image of the web application, which is served at the same port if the
        machine can run containers; '' for none.
    :raises ConfigurationError: an invalid port, pattern or network.
    """

    def __init__(
        self, machine: SomeMachine, topics: Sequence[SomeSubstitutionsType] = ('*',),
        port: Union[int, SomeSubstitutionsType] = addresses.PORT, *,
        monitor_allow: Optional[Sequence[SomeSubstitutionsType]] = None,
        image: SomeSubstitutionsType = addresses.IMAGE, **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if isinstance(topics, str) or not topics:
            raise ConfigurationError(
                f'topics={topics!r} is no list of patterns', "such as ['/camera/*', '/tf']")
        self.machine = machine
        self._topics = list(topics)
        self._port = port
        self._allow = networks.items(monitor_allow)
        self._image = image
        if isinstance(port, (int, str)):
            _port(port)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Start the bridge when the machine is up, and log its address when it runs."""
        coordinator = Coordinator.of(context)
        port = _port(words.resolve(context, self._port))
        topics = [words.resolve(context, topic) for topic in self._topics]
        allow = networks.resolve(context, self._allow)
        if coordinator.on_robot(self.machine):
            return self._on_robot(coordinator, port, topics)
        session = coordinator.session(self.machine)
        folder = addresses.folder_of(_AGENT, port, coordinator.launch.id)
        options = ['--secrets', folder, '--vpn', str(port)]
        provider = coordinator.launch.provider(session.spec.provider)
        if session.spec.monitored and provider.application_port:
            options += ['--application', f'127.0.0.1:{provider.application_port}']
        with contextlib.suppress(Unsupported):
            provider.check_containers(session.spec)
            options += ['--image', words.resolve(context, self._image)]
        if allow:
            options += ['--guarded', str(addresses.guarded_port(port)), *(
                word for network in allow for word in ('--allow', network))]
        process = Carrier(_bridge(session.spec.name, port, topics, options))
        send(process, session.spec.name)
        return [process, _once_started(process, lambda: _tell(session, port, allow))]

    def _on_robot(
        self, coordinator: Coordinator, port: int, topics: Sequence[str],
    ) -> list[LaunchDescriptionEntity]:
        """Serve the robot's topics on its loopback; delete the token when the launch ends."""
        machine = coordinator.resolve(self.machine)
        name = machine if isinstance(machine, str) else machine.name
        folder = addresses.on_robot(Store(), name)
        process = Carrier(_bridge('robot', port, topics, [
            '--secrets', addresses.folder_of(str(folder), port, str(os.getpid()))]))
        return [process, _once_started(process, lambda: _logger().info(
            f"{name}: Foxglove at {addresses.bridge('localhost', port)}; "
            f'in a browser: ros2 fog monitor {name}')),
            RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: shutil.rmtree(
                folder, ignore_errors=True)))]


def _port(value: Union[int, str]) -> int:
    try:
        port = int(value)
    except ValueError:
        port = 0
    if not 0 < port < 65536:
        raise ConfigurationError(f'port={value!r} is no TCP port', f'use 1 to 65535, such as '
                                 f'{addresses.PORT}')
    return port


def _bridge(
    where: str, port: int, topics: Sequence[str], options: Sequence[str] = (),
) -> NodeSpec:
    package, executable = plugin_system.load('fogros2.monitor', 'foxglove')
    return NodeSpec(
        id=f'foxglove-{where}-{port}', name='foxglove_bridge', package=package,
        executable=executable, respawn=True, respawn_delay=_RESPAWN,
        # with ROS arguments the bridge gets the renamed topics of streams, as the machine's nodes
        # do; otherwise its images would cross the VPN from the robot uncompressed
        arguments=('--name', where, '--listen', f'127.0.0.1:{port}', *options,
                   *(word for topic in topics for word in ('--topic', topic)), '--ros-args'))


def _once_started(process: Carrier, then: Callable[[], None]) -> RegisterEventHandler:
    return RegisterEventHandler(OnProcessStart(
        target_action=process, on_start=OpaqueFunction(function=lambda _: then())))


def _tell(session: Session, port: int, allow: Sequence[str]) -> None:
    assert session.running is not None
    session.running.serves(port)
    name = session.spec.name
    _logger().info(
        f'{name}: Foxglove at {addresses.bridge(session.running.vpn_address, port)}; '
        f'in a browser: ros2 fog monitor {name}')
    if allow:
        session.publish(addresses.guarded_port(port), allow, lambda host, outside: _logger().info(
            f"{name}: Foxglove for {', '.join(allow)} at wss://{addresses.place(host, outside)}; "
            f'with its token: ros2 fog monitor {name} --share'))


def _logger() -> logging.Logger:
    found: logging.Logger = launch.logging.get_logger('fogros2')
    return found
