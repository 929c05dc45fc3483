# SPDX-License-Identifier: Apache-2.0
"""Foxglove: show the topics of a machine in a browser."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, TYPE_CHECKING, Union

from launch import Action, LaunchContext, LaunchDescriptionEntity

from fogros2 import monitor_addresses as addresses
from fogros2.describe import networks, values
from fogros2.errors import ConfigurationError
from fogros2.runtime import foxglove
from fogros2.runtime.coordinator import Coordinator
from fogros2.runtime.remote_process import send

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import SomeMachine


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
        port = _port(values.resolve(context, self._port))
        topics = [values.resolve(context, topic) for topic in self._topics]
        allow = networks.resolve(context, self._allow)
        machine = coordinator.resolve(self.machine)
        if coordinator.on_robot(machine):
            return foxglove.on_robot(
                machine if isinstance(machine, str) else machine.name, port, topics)
        session = coordinator.session(machine)
        bridge, started = foxglove.on_machine(
            coordinator, session, port=port, topics=topics, allow=allow,
            image=values.resolve(context, self._image))
        send(bridge, session.spec.name)
        return [bridge, started]


def _port(value: Union[int, str]) -> int:
    try:
        port = int(value)
    except ValueError:
        port = 0
    if not 0 < port < 65536:
        raise ConfigurationError(f'port={value!r} is no TCP port', f'use 1 to 65535, such as '
                                 f'{addresses.PORT}')
    return port
