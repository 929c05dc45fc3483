# SPDX-License-Identifier: Apache-2.0
"""The Foxglove bridge of a machine: ``launch_foxglove=True``, ``monitor_allow=[...]``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from typing import Any, ClassVar, Optional, TYPE_CHECKING

from fogros2 import plugin_system
from fogros2.errors import Unsupported
from fogros2.feature import Feature
from fogros2.model import CreateRequest, MachineSpec
from fogros2_monitor import addresses, networks

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Bool


class Monitor(Feature):
    """A bridge that starts with the first node, and what ``ros2 fog`` shows of any bridge."""

    notes: ClassVar[Mapping[str, str]] = {
        addresses.NOTE: 'topics at {note}; with its token: ros2 fog monitor {name}',
        addresses.NOTE_OPEN: ''}

    @staticmethod
    def options(
        launch_foxglove: Bool = False,
        monitor_allow: Optional[Sequence[SomeSubstitutionsType]] = None,
    ) -> Optional[tuple[str, ...]]:
        """
        Return the networks of external clients in CIDR form, None for no bridge.

        :param launch_foxglove: serve the machine's topics to Foxglove.
        :param monitor_allow: networks (CIDR) from which external clients may connect to the
            bridge, by TLS and with a token.
        """
        allowed = tuple(networks.normal(str(network)) for network in monitor_allow or ())
        return allowed if launch_foxglove or allowed else None

    def check(self, spec: MachineSpec, own: Optional[Sequence[str]]) -> None:
        """Check that the machine may serve viewers, and that others reach it."""
        can = plugin_system.load('fogros2.provider', spec.provider).capabilities
        if own is not None and can.account:
            raise Unsupported(f"'{spec.name}' is another robot's, and serves no viewer",
                              'leave launch_foxglove and monitor_allow out')
        if own and not can.ports:
            raise Unsupported(f"'{spec.name}' can't open a port of its host for monitor_allow",
                              "leave it out, and use 'ros2 fog monitor'")

    def request(self, request: CreateRequest, own: Optional[Sequence[str]]) -> CreateRequest:
        """Have Lichtblick run beside the machine."""
        return request if own is None else dataclasses.replace(
            request, application=addresses.IMAGE)

    def beside(self, spec: MachineSpec, own: Optional[Sequence[str]]) -> Sequence[Any]:
        """Return the action that starts the bridge."""
        from fogros2_monitor.action import DefaultFoxglove
        return [] if own is None else [DefaultFoxglove(spec.name, monitor_allow=own)]
