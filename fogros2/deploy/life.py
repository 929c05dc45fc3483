# SPDX-License-Identifier: Apache-2.0
"""Decide how a machine of a launch ends, and whether anything on it stays to be undone."""

from __future__ import annotations

import dataclasses
from typing import get_args, Literal

#: In the order in which they may follow. ``new``: the launch creates it. ``kept``: an earlier
#: launch has created it. ``up``: its nodes may run. ``ended``: the launch goes on without it.
#: ``lost``: it does not answer, or is replaced, and may still run. ``stopped`` and ``deleted``:
#: its provider reports that.
Phase = Literal['new', 'kept', 'up', 'ended', 'lost', 'stopped', 'deleted']


@dataclasses.dataclass(frozen=True)
class Life:
    """
    The phase of a machine in one launch.

    :param reason: why the launch does not use it any more, '' while it does.
    """

    phase: Phase = 'new'
    reason: str = ''

    def then(self, phase: Phase, reason: str = '') -> Life:
        """Return what follows; a phase that comes too late changes nothing."""
        order = get_args(Phase)
        if order.index(phase) <= order.index(self.phase):
            return self
        return Life(phase, self.reason or reason)

    @property
    def begun(self) -> bool:
        """Whether it has come up."""
        return self.phase not in ('new', 'kept')

    @property
    def over(self) -> bool:
        """Whether the launch ignores its events."""
        return self.begun and self.phase != 'up'

    @property
    def lost(self) -> str:
        """Why it must not be used any more; one that the launch ends may help to the last."""
        return '' if self.phase == 'ended' else self.reason

    def ending(self, on_exit: str) -> str:
        """Return what the launch does with it: 'delete', 'stop' or 'keep'."""
        return 'delete' if self.phase in ('new', 'deleted') else on_exit

    def survives(self, on_exit: str, *, owned: bool, stopped: bool = False) -> bool:
        """
        Return whether it outlives the launch, so that the launch has to clean it up.

        :param owned: whether FogROS2 owns it, and ends it.
        :param stopped: whether one that the launch stops counts too, as it keeps its firewall.
        """
        if self.phase in ('stopped', 'deleted'):
            return False
        ending = self.ending(on_exit)
        return not owned or ending == 'keep' or stopped and ending == 'stop'
