# SPDX-License-Identifier: Apache-2.0
"""Run the Foxglove bridge of a machine, or of the robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import logging
import os
import shutil
from typing import TYPE_CHECKING

from launch import LaunchDescriptionEntity
from launch.actions import OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessStart, OnShutdown
import launch.logging

from fogros2 import monitor_addresses as addresses
from fogros2 import plugin_system
from fogros2.errors import Unsupported
from fogros2.model import host_port, NodeSpec
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.coordinator import Coordinator
from fogros2.store import Store

if TYPE_CHECKING:
    from fogros2.runtime.session import Session

#: Seconds before a bridge that ended is started again.
_RESPAWN = 2.0
#: The agent's folder, as a process on the machine sees it.
_AGENT = '$FOGROS2_AGENT_DIRECTORY'


def on_machine(
    coordinator: Coordinator, session: Session, *, port: int = addresses.PORT,
    topics: Sequence[str] = ('*',), allow: Sequence[str] = (), image: str = addresses.IMAGE,
) -> tuple[AddedProcess, RegisterEventHandler]:
    """
    Return the bridge of a machine, not sent there yet, and the handler that logs its address.

    :param allow: networks (CIDR) of external clients.
    :param image: container image of the web application; '' for none.
    """
    folder = addresses.folder_of(_AGENT, port, coordinator.launch.id)
    options = ['--secrets', folder, '--vpn', str(port)]
    provider = coordinator.launch.provider(session.spec.provider)
    if session.spec.monitored and provider.capabilities.application_port:
        options += ['--application', f'127.0.0.1:{provider.capabilities.application_port}']
    with contextlib.suppress(Unsupported):
        provider.check_containers(session.spec)
        options += ['--image', image]
    if allow:
        options += ['--public', str(addresses.gate_port(port)), *(
            argument for network in allow for argument in ('--allow', network))]
    process = AddedProcess(_bridge(session.spec.name, port, topics, options))
    return process, _once_started(process, lambda: _report(session, port, allow))


def on_robot(
    name: str, port: int, topics: Sequence[str],
) -> list[LaunchDescriptionEntity]:
    """Serve the robot's topics on its loopback; delete the token when the launch ends."""
    folder = addresses.on_robot(Store(), name)
    process = AddedProcess(_bridge('robot', port, topics, [
        '--secrets', addresses.folder_of(str(folder), port, str(os.getpid()))]))
    return [process, _once_started(process, lambda: _logger().info(
        f"{name}: Foxglove at {addresses.bridge('localhost', port)}; "
        f'in a browser: ros2 fog monitor {name}')),
        RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: shutil.rmtree(
            folder, ignore_errors=True)))]


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
                   *(argument for topic in topics for argument in ('--topic', topic)),
                   '--ros-args'))


def _once_started(process: AddedProcess, then: Callable[[], None]) -> RegisterEventHandler:
    return RegisterEventHandler(OnProcessStart(
        target_action=process, on_start=OpaqueFunction(function=lambda _: then())))


def _report(session: Session, port: int, allow: Sequence[str]) -> None:
    assert session.running is not None
    session.running.serves(port)
    name = session.spec.name
    _logger().info(
        f'{name}: Foxglove at {addresses.bridge(session.running.vpn_address, port)}; '
        f'in a browser: ros2 fog monitor {name}')

    def opened(host: str, outside: int) -> None:
        _logger().info(
            f"{name}: Foxglove for {', '.join(allow)} at wss://{host_port(host, outside)}; "
            f'with its token: ros2 fog monitor {name} --share')

    if allow:
        session.open_port(addresses.gate_port(port), allow, opened)


def _logger() -> logging.Logger:
    logger: logging.Logger = launch.logging.get_logger('fogros2')
    return logger
