# SPDX-License-Identifier: Apache-2.0
"""The plugin interface of ROS middlewares: interfaces and peers of a launch's nodes."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
import math
import socket
from types import MappingProxyType
from typing import ClassVar, Optional

from fogros2.errors import DdsError
from fogros2.model import Command, DdsInterface
from fogros2.vpn.addresses import dds_ports

#: Variables that decide which nodes hear each other, and hold only on one host.
VARIABLES = (
    'CYCLONEDDS_URI', 'FASTDDS_BUILTIN_TRANSPORTS', 'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTRTPS_DEFAULT_PROFILES_FILE', 'RMW_IMPLEMENTATION', 'ROS_AUTOMATIC_DISCOVERY_RANGE',
    'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'SKIP_DEFAULT_XML_FILE',
    'ZENOH_CONFIG_OVERRIDE', 'ZENOH_SESSION_CONFIG_URI',
)


@dataclasses.dataclass(frozen=True)
class Router:
    """
    A program that connects the nodes of a host with each other and with other hosts.

    :param package: with ``executable`` names a program of the ament index.
    :param variable: environment variable with the path of its configuration file.
    :param config: content of that file.
    :param beside: address and TCP port of the router of the host's other nodes, if this one does
        not connect to it.
    """

    package: str
    executable: str
    variable: str
    config: str
    beside: Optional[tuple[str, int]] = None


class DdsVendor(abc.ABC):
    """
    A ROS middleware whose interfaces and peers can be configured; pure.

    :param domain: ROS_DOMAIN_ID of the launch.
    :raises DdsError: the middleware does not support the domain.
    """

    #: Value of RMW_IMPLEMENTATION.
    rmw: ClassVar[str]
    #: Whether the VPN interface is configured by its address instead of its name.
    by_address: ClassVar[bool] = False
    #: Whether the robot's nodes announce themselves to each machine's address, too.
    asks_machines: ClassVar[bool] = False
    #: The number of a machine's processes that those of another machine always discover.
    asked_processes: ClassVar[float] = math.inf
    #: Name of the configuration file; some middlewares require a suffix.
    file_name: ClassVar[str] = 'dds.xml'
    #: The last domain for which DDS has ports. Domains above 101 use Linux's ephemeral ports.
    last_domain: ClassVar[int] = 232

    def __init__(self, domain: int = 0) -> None:
        if not 0 <= domain <= self.last_domain:
            raise DdsError(f'ROS_DOMAIN_ID {domain} has no DDS ports', 'use 0 to 101')
        self.domain = domain

    @property
    def ports(self) -> Sequence[tuple[int, int]]:
        """The ranges of UDP ports, (first, last), on which the robot's nodes listen."""
        return [dds_ports(self.domain)]

    def asked(self, user: Mapping[str, str]) -> list[str]:
        """Return the hosts that the user configured for nodes to ask, names or addresses."""
        return static_peers(user)

    def ask_lan(self) -> Command:
        """Return the robot's command for ``parse_lan``; by default no output is needed."""
        return Command(('true',), what='look at the network interfaces')

    def parse_lan(self, output: str) -> Optional[str]:
        """Return the LAN interface that nodes use by default, None without one."""
        return None

    @abc.abstractmethod
    def robot_interfaces(
        self, vpn: str, lan: Optional[str], user: Mapping[str, str],
    ) -> list[DdsInterface]:
        """
        Return the interfaces of the robot's nodes: those that they use anyway, and the VPN.

        :param vpn: name of the VPN interface, or its address (``by_address``).
        :param lan: result of ``parse_lan``.
        :param user: the user's environment variables.
        :raises DdsError: the user's configuration does not allow the VPN.
        """

    @abc.abstractmethod
    def machine_interfaces(self, vpn: str) -> list[DdsInterface]:
        """Return the interfaces of a machine's nodes: the VPN and the loopback."""

    @abc.abstractmethod
    def render(
        self, interfaces: Sequence[DdsInterface], peers: Sequence[str],
        user: Mapping[str, str] = MappingProxyType({}), *, quiet: bool = False,
    ) -> str:
        """
        Return the text of the configuration file.

        :param interfaces: the interfaces that the nodes use.
        :param peers: addresses of hosts to ask for participants, without 127.0.0.1.
        :param user: the user's environment variables, for middlewares that read only one file: the
            user's configuration is merged into that file.
        :param quiet: the nodes may be in VPNs of several robots: announce no multicast group.
        """

    @abc.abstractmethod
    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return the variables that make nodes read the file at ``path``.

        :param user: the user's environment variables; their configuration stays, ours follows.
        """

    def router(
        self, address: str, others: Sequence[str], user: Optional[Mapping[str, str]],
    ) -> Optional[Router]:
        """
        Return the router that has to run beside the nodes of a host; None, the default, for none.

        :param address: the host's VPN address.
        :param others: VPN addresses of hosts that it has to find.
        :param user: the robot's user environment; None on a machine.
        """
        return None


def local_only(user: Mapping[str, str]) -> bool:
    """Return whether the user limits ROS 2 to this computer."""
    return (user.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() == 'LOCALHOST'
            or user.get('ROS_LOCALHOST_ONLY') == '1')


def check_discovery(user: Mapping[str, str]) -> None:
    """
    Check that nodes find each other.

    :raises DdsError: the user's environment disables discovery.
    """
    if user.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() == 'OFF':
        raise DdsError(
            'ROS_AUTOMATIC_DISCOVERY_RANGE is OFF, so no node would find another',
            'unset ROS_AUTOMATIC_DISCOVERY_RANGE')


def static_peers(user: Mapping[str, str]) -> list[str]:
    """Return the hosts in ROS_STATIC_PEERS, which are separated by ``;``."""
    return [host.strip() for host in user.get('ROS_STATIC_PEERS', '').split(';') if host.strip()]


def addresses_of(hosts: Sequence[str]) -> list[str]:
    """Return the IPv4 addresses of hosts, without those that are unknown."""
    addresses: set[str] = set()
    for host in hosts:
        with contextlib.suppress(OSError, UnicodeError):
            addresses |= {str(info[4][0])
                          for info in socket.getaddrinfo(host, None, socket.AF_INET)}
    return sorted(addresses)
