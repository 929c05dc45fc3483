# SPDX-License-Identifier: Apache-2.0
"""The event of a machine that ends before its launch does."""

from __future__ import annotations

from launch import Event


class MachineInterrupted(Event):
    """
    The provider reclaims a machine of the launch, or has done so; emitted once for each machine.

    Handlers see it before the launch itself acts::

        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own from now on')]))

    :param machine: the machine's name.
    :param reason: the provider's explanation.
    :param lost: True if the machine is gone; False if it still runs for some time.
    """

    name = 'fogros2.MachineInterrupted'

    def __init__(self, machine: str, reason: str, lost: bool) -> None:
        super().__init__()
        self.machine = machine
        self.reason = reason
        self.lost = lost

    def __str__(self) -> str:
        what = 'is gone' if self.lost else 'is being reclaimed'
        return f"the machine '{self.machine}' {what}: {self.reason}"
