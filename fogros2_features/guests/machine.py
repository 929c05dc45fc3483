# SPDX-License-Identifier: Apache-2.0
"""Another robot's machine in a launch file."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from fogros2.describe.kinds import options_of
from fogros2.describe.machines import CloudInstance

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType


class JoinedMachine(CloudInstance):
    """
    A machine of another robot, on which this launch has an account of its own.

    The account ends with the invitation; what the launch's nodes need besides the workspace has
    to be on the machine.

    :param invitation: what ``ros2 fog invite`` printed on the other robot for this computer.
    """

    provider = 'joined'

    def __init__(self, invitation: SomeSubstitutionsType, **common: Any) -> None:
        super().__init__(options=options_of(JoinedMachine.__init__, locals()), **common)
