# SPDX-License-Identifier: Apache-2.0
"""The seam to the VPN: pure functions from interfaces and peers to commands."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence

from fogros2.model import Command, Peer, VpnInterface


class Vpn(abc.ABC):
    """
    A virtual private network between the robot and its machines.

    The methods decide nothing at run time and do no I/O: they return commands, for the robot or
    for a machine (the same ones), each idempotent, in order.
    """

    @abc.abstractmethod
    def keys(self, interface: VpnInterface) -> Command:
        """Return the command that makes the private key where missing and prints the public."""

    @abc.abstractmethod
    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what makes the interface, with these peers and no others, and brings it up."""

    @abc.abstractmethod
    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what replaces the peers of an interface that is up; sessions go on."""

    @abc.abstractmethod
    def alive(self, interface: VpnInterface) -> Command:
        """Return a cheap command that exits 0 while the interface's program runs."""

    @abc.abstractmethod
    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what gets a VPN whose program died going again; the interface stays."""

    @abc.abstractmethod
    def status(self, interface: VpnInterface) -> Command:
        """Return a command whose output ``parse_status`` understands."""

    @abc.abstractmethod
    def parse_status(self, output: str) -> dict[str, dict[str, float]]:
        """
        Return per peer (by public key) ``handshake`` (s since the epoch), ``received``, ``sent``.

        The counters are bytes; a handshake of 0 means none so far.
        """

    @abc.abstractmethod
    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield what takes everything of ``up`` away, the key file too."""
