# SPDX-License-Identifier: Apache-2.0
"""Foxglove: show the topics of a machine, or of the robot, in a browser."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
import contextlib
import functools
import logging
import os
from pathlib import Path
import shutil
from typing import Any, Optional, TYPE_CHECKING, Union
from weakref import WeakKeyDictionary

from launch import Action, LaunchContext, LaunchDescriptionEntity
from launch.actions import EmitEvent, ExecuteLocal, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessStart, OnShutdown
from launch.events.process import ShutdownProcess
import launch.logging

from fogros2 import feature
from fogros2.describe import features, values
from fogros2.errors import ConfigurationError, Unsupported
from fogros2.model import host_port, NodeSpec
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.coordinator import Coordinator
from fogros2.runtime.remote_process import send
from fogros2.store import Store
from fogros2_monitor import addresses

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import SomeMachine
    from fogros2.runtime.session import Session

#: Seconds before a bridge that ended is started again.
_RESPAWN = 2.0
#: The agent's folder, as a process on the machine sees it.
_AGENT = '$FOGROS2_AGENT_DIRECTORY'
#: Ids of bridges.
_DEFAULT, _OTHER = 'foxglove-default-{}-{}', 'foxglove-{}-{}'
#: Machine and port of the bridges in a launch, but for the default ones.
_BRIDGES: WeakKeyDictionary[LaunchContext, set[tuple[str, int]]] = WeakKeyDictionary()


class Foxglove(Action):
    """
    Serve the ROS graph that a machine sees to Foxglove or Lichtblick in a browser.

    The bridge listens on the machine's loopback interface and in the VPN, and admits clients with
    its token. ``ros2 fog monitor`` prints the token, on the robot and for users who may log in to
    the machine. If the machine is the robot itself, the bridge listens on its loopback only.

    :param machine: the machine, or the name of one that the launch mentions elsewhere.
    :param topics: patterns (``*``, ``?``) of the topics, services and parameters to show.
    :param port: TCP port; the next two ports serve external clients and the web application.
    :param monitor_allow: networks (CIDR) of external clients, which connect to the port after
        that one by TLS and with the token. The launch opens the port in the provider's firewall,
        if there is one. The machine itself refuses other addresses.
    :param image: container image of the web application, which is served at the same port if the
        machine can run containers; '' for none.
    :raises ConfigurationError: an invalid port, pattern or network.
    """

    _default = False

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
        self._allow = features.own({'monitor_allow': monitor_allow})
        self._asked = monitor_allow is not None
        self._image = image
        if isinstance(port, (int, str)):
            _port(port)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Start the bridge when the machine is up, and log its address when it runs."""
        coordinator = Coordinator.of(context)
        port = _port(values.resolve(context, self._port))
        topics = [values.resolve(context, topic) for topic in self._topics]
        allow = feature.options('monitor', {
            name: values.resolve(context, value) for name, value in self._allow.items()}) or ()
        machine = coordinator.resolve(self.machine)
        if coordinator.on_robot(machine):
            return _on_robot(machine if isinstance(machine, str) else machine.name, port, topics)
        session = coordinator.session(machine)
        name, known = session.spec.name, _BRIDGES.setdefault(context, set())
        replaced: list[LaunchDescriptionEntity] = []
        if not self._default:
            if (name, port) in known:
                raise ConfigurationError(f"'{name}' has two bridges at port {port}",
                                         'give one of them another port=')
            known.add((name, port))
        elif (name, port) in known:
            return []
        if port == addresses.PORT and not self._default:
            replaced.append(EmitEvent(event=ShutdownProcess(
                process_matcher=functools.partial(_is_default, name))))
            allow = allow if self._asked else _networks(session) or ()
        bridge = AddedProcess(_bridge(name, port, topics, _options(
            coordinator, session, port, allow, values.resolve(context, self._image)),
            _DEFAULT if self._default else _OTHER))
        send(bridge, name)
        return [*replaced, bridge, _once_started(bridge, lambda: _report(session, port, allow))]


class DefaultFoxglove(Foxglove):
    """The bridge of ``launch_foxglove=True``; another one at its port takes its place."""

    _default = True


def _is_default(machine: str, process: ExecuteLocal) -> bool:
    return isinstance(process, AddedProcess) and process.node == _DEFAULT.format(
        machine, addresses.PORT)


def _networks(session: Session) -> Optional[Sequence[str]]:
    """Return the networks that the machine itself admits; None if it has no default bridge."""
    networks: Optional[Sequence[str]] = feature.options(
        'monitor', session.spec.features.get('monitor', {}))
    return networks


def _port(value: Union[int, str]) -> int:
    try:
        port = int(value)
    except ValueError:
        port = 0
    if not 0 < port < 65536:
        raise ConfigurationError(f'port={value!r} is no TCP port', f'use 1 to 65535, such as '
                                 f'{addresses.PORT}')
    return port


def _options(
    coordinator: Coordinator, session: Session, port: int, allow: Sequence[str], image: str,
) -> list[str]:
    """Return the options of a machine's bridge, which is not sent there yet."""
    folder = addresses.folder_of(_AGENT, port, coordinator.launch.id)
    options = ['--secrets', folder, '--vpn', str(port)]
    spec = session.spec
    provider = coordinator.launch.provider(spec.provider)
    beside = provider.capabilities.application_port
    if beside and _networks(session) is not None:
        options += ['--application', f'127.0.0.1:{beside}']
    with contextlib.suppress(Unsupported):
        provider.check_containers(spec)
        options += ['--image', image]
    if allow:
        options += ['--public', str(addresses.gate_port(port)), *(
            argument for network in allow for argument in ('--allow', network))]
    return options


def _on_robot(name: str, port: int, topics: Sequence[str]) -> list[LaunchDescriptionEntity]:
    """Serve the robot's topics on its loopback; delete the token when the launch ends."""
    folder = Path(addresses.folder_of(
        str(addresses.on_robot(Store(), name)), port, addresses.of_process(os.getpid())))
    process = AddedProcess(_bridge('robot', port, topics, [
        '--secrets', str(folder)]))
    return [process, _once_started(process, lambda: _logger().info(
        f"{name}: Foxglove at {addresses.bridge('127.0.0.1', port)}; "
        f'in a browser: ros2 fog monitor {name}')),
        RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: _remove(folder)))]


def _remove(folder: Path) -> None:
    """Delete a launch's credentials, and the folders above that no other launch uses."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


def _bridge(
    where: str, port: int, topics: Sequence[str], options: Sequence[str], identity: str = '',
) -> NodeSpec:
    return NodeSpec(
        id=(identity or _OTHER).format(where, port), name='foxglove_bridge', package='fogros2',
        executable='bridge', respawn=True, respawn_delay=_RESPAWN,
        # with ROS arguments the bridge gets the renamed topics of streams, as the machine's nodes
        # do; otherwise its images would cross the VPN from the robot uncompressed
        arguments=('--name', where, '--listen', f'127.0.0.1:{port}', *options,
                   *(argument for topic in topics for argument in ('--topic', topic)),
                   '--ros-args'))


def _once_started(process: AddedProcess, then: Callable[[], None]) -> RegisterEventHandler:
    return RegisterEventHandler(OnProcessStart(
        target_action=process, on_start=OpaqueFunction(function=lambda _: then())))


def _report(session: Session, port: int, allow: Sequence[str]) -> None:
    running, name = session.running, session.spec.name
    assert running is not None
    address = addresses.bridge(running.vpn_address, port)
    running.note(addresses.NOTE, address)
    _logger().info(f'{name}: Foxglove at {address}; in a browser: ros2 fog monitor {name}')

    async def open_port() -> None:
        where = host_port(*await asyncio.to_thread(
            running.open_port, addresses.gate_port(port), allow))
        running.note(addresses.NOTE_OPEN, where)
        _logger().info(f"{name}: Foxglove for {', '.join(allow)} at wss://{where}; "
                       f'with its token: ros2 fog monitor {name} --share')

    if allow:
        session.request(open_port)


def _logger() -> logging.Logger:
    logger: logging.Logger = launch.logging.get_logger('fogros2')
    return logger
