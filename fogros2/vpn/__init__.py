# SPDX-License-Identifier: Apache-2.0
"""
The plugin interface of VPNs: pure functions from interfaces and peers to commands.

``addresses`` chooses the subnet of a launch. ``wireguard`` has the commands, and ``owner`` tells
whose an interface is. ``helped`` is the plugin: on the robot it may use the root helper.

A machine's interface NAME may have further peers. Then root has a Python program at
``/run/NAME.more``. The plugin's commands run it with NAME and

- ``peers`` to print the peers, as a configuration of ``wg``;
- ``look`` when the time in ``/run/NAME.more.due`` has come, in seconds since boot;
- ``stay`` before a launch that keeps its machine takes the interface down. If it succeeds, the
  program takes it down later;
- ``clear`` before the interface ends. Its files ``/run/NAME.more.*`` go with the interface.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence

from fogros2.model import Command, Peer, VpnInterface

#: Bytes of the largest packet in a VPN: with WireGuard's headers, it fits paths of 1360 bytes. A
#: mobile network or a firewall may have such a path, and lose larger packets without a report.
MTU = 1280
#: What the commands of ``Vpn.leave`` print if the interface stays.
STAYS = 'stays'


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
        """Return the command whose output ``parse_status`` reads; it fails without a filter."""

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
        """Yield the commands of ``down``, which print ``STAYS`` if further peers keep it."""
        return self.down(interface)
