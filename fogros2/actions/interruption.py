# SPDX-License-Identifier: Apache-2.0
"""What launch files can learn of a machine that its provider takes away."""

from __future__ import annotations

from launch import Event


class MachineInterrupted(Event):
    """
    The provider takes a machine of the launch away, or has; emitted once for each.

    Handlers see it before the machine's ``on_interrupt`` has its effect::

        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[LogInfo(msg='on our own from now on')]))

    :param machine: its name.
    :param reason: in the provider's words.
    :param lost: whether it is gone already; False while it runs for some time still.
    """

    name = 'fogros2.MachineInterrupted'

    def __init__(self, machine: str, reason: str, lost: bool) -> None:
        super().__init__()
        self.machine = machine
        self.reason = reason
        self.lost = lost
