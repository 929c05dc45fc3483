# SPDX-License-Identifier: Apache-2.0
"""The seam to DDS: which interfaces and peers a launch's nodes use, as the middleware wants it."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
import dataclasses
import ipaddress
from types import MappingProxyType
from typing import ClassVar, Optional

from fogros2.errors import DdsError
from fogros2.model import Command, DdsInterface


@dataclasses.dataclass(frozen=True)
class Router:
    """
    A program at which the nodes of a host meet each other, and other hosts.

    :param package: with ``executable`` names a program of the ament index.
    :param variable: names the file with ``config`` to it.
    """

    package: str
    executable: str
    variable: str
    config: str


class DdsVendor(abc.ABC):
    """
    A ROS middleware whose interfaces and peers can be configured; pure.

    :param domain: ROS_DOMAIN_ID of the launch.
    :raises DdsError: the middleware has no such domain.
    """

    #: Value of RMW_IMPLEMENTATION.
    rmw: ClassVar[str]
    #: Ranges of UDP ports, first and last, that the robot's nodes listen at beside the domain's.
    ports: ClassVar[Sequence[tuple[int, int]]] = ()
    #: Whether the VPN's interface is configured by its address in place of its name.
    by_address: ClassVar[bool] = False
    #: What the configuration's file is called, where the middleware minds.
    file_name: ClassVar[str] = 'dds.xml'
    #: The last domain; DDS has ports for no more. Those above 101 take ports that Linux hands out.
    last_domain: ClassVar[int] = 232

    def __init__(self, domain: int = 0) -> None:
        if not 0 <= domain <= self.last_domain:
            raise DdsError(f'ROS_DOMAIN_ID {domain} has no DDS ports', 'use 0 to 101')
        self.domain = domain

    def ask_lan(self) -> Command:
        """Return the command, for the robot, whose output ``parse_lan`` reads; unless it minds."""
        return Command(('true',), what='look at the network interfaces')

    def parse_lan(self, output: str) -> Optional[str]:
        """Return the interface that nodes would take by themselves, None where there is none."""
        return None

    @abc.abstractmethod
    def robot_interfaces(
        self, vpn: str, lan: Optional[str], user: Mapping[str, str],
    ) -> list[DdsInterface]:
        """
        Return the interfaces of the robot's nodes: what is there without us, and the VPN.

        :param vpn: name of the VPN's interface.
        :param lan: of ``parse_lan``.
        :param user: the environment as the user has it.
        :raises DdsError: the user's configuration leaves no place for the VPN.
        """

    @abc.abstractmethod
    def machine_interfaces(self, vpn: str) -> list[DdsInterface]:
        """Return the interfaces of a machine's nodes: the VPN and the machine itself."""

    @abc.abstractmethod
    def render(
        self, interfaces: Sequence[DdsInterface], peers: Sequence[str],
        user: Mapping[str, str] = MappingProxyType({}),
    ) -> str:
        """
        Return the configuration file's text.

        :param interfaces: those the nodes use.
        :param peers: addresses asked for participants, ours (127.0.0.1) not among them.
        :param user: the environment as the user has it, for middlewares that read one file alone:
            what it configures goes into that.
        """

    @abc.abstractmethod
    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return the variables that make nodes read the file at ``path``.

        :param user: the environment as the user has it; what it configures is kept, ours after it.
        """

    def router(
        self, address: str, others: Sequence[str], user: Optional[Mapping[str, str]],
    ) -> Optional[Router]:
        """
        Return what has to run beside the nodes of a host; None, the default, for nothing.

        :param address: the host's in the VPN.
        :param others: those of hosts that it shall find.
        :param user: the robot's environment as the user has it; None on a machine.
        """
        return None


def static_peers(user: Mapping[str, str]) -> list[str]:
    """Return the hosts of ROS_STATIC_PEERS, which has ``;`` between them."""
    return [host.strip() for host in user.get('ROS_STATIC_PEERS', '').split(';') if host.strip()]


def is_address(text: str) -> bool:
    """Return whether a text is an IP address, not a name."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
