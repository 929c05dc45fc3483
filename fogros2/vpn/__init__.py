# SPDX-License-Identifier: Apache-2.0
"""
The plugin interface of VPNs: pure functions from interfaces and peers to commands.

``addresses`` chooses the subnet of a launch. ``guests`` is a program that the commands of
``wireguard`` run; it admits computers to a machine's interface. ``owner`` tells whose an interface
is. ``helped`` is the plugin: on the robot it may use the root helper.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence

from fogros2.model import Command, Peer, VpnInterface


class Vpn(abc.ABC):
    """
    A virtual private network between the robot and its machines.

    The methods are pure and do no I/O: they return idempotent commands, in order, for the robot
    or for a machine.
    """

    @abc.abstractmethod
    def keys(self, interface: VpnInterface) -> Command:
        """Return the command that creates the key pair if missing, and prints the public key."""

    @abc.abstractmethod
    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that create the interface with exactly these peers, and enable it."""

    @abc.abstractmethod
    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that replace the peers of a running interface; sessions continue."""

    @abc.abstractmethod
    def health_check(self, interface: VpnInterface) -> Command:
        """Return a cheap command with exit status 0 while the interface's program runs."""

    @abc.abstractmethod
    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that restart a VPN whose program ended; the interface stays."""

    @abc.abstractmethod
    def status(self, interface: VpnInterface) -> Command:
        """Return the command whose output ``parse_status`` reads."""

    @abc.abstractmethod
    def parse_status(self, output: str) -> dict[str, dict[str, float]]:
        """
        Return by public key ``handshake`` (s since the epoch), ``received`` and ``sent`` (bytes).

        A handshake of 0 means that there was none.
        """

    @abc.abstractmethod
    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield the commands that undo ``up`` and delete the key file."""

    def leave(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield the commands of ``down`` for a machine that is kept; guests may need more time."""
        return self.down(interface)
