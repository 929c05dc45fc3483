# SPDX-License-Identifier: Apache-2.0
"""Azure in a box as a test holds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from rigs.azure import catalogue, service
from rigs.computers.box import Box


class AzureBox(Box):
    """
    Azure in a box: its REST API, and for each machine a container that is its computer.

    It takes ``azure-mgmt-compute`` and ``azure-mgmt-network``, whose models know the members of a
    request's body, besides what every box takes.
    """

    SERVER: ClassVar[str] = 'rigs.azure.server'
    REGIONS: ClassVar[Sequence[str]] = catalogue.REGIONS

    def environment(self) -> dict[str, str]:
        """Return the variables by which programs on the robot take the box for Azure."""
        return service.environment(self.inside)

    def set_rights(self, *, owner: bool, propagation: float = 0.0) -> None:
        """Let the user be an owner or a contributor; a role works after ``propagation`` s."""
        self._ask({'do': 'rights', 'owner': owner, 'propagation': propagation})

    def things(self) -> dict[str, dict[str, Any]]:
        """Return all groups by name, and all resources by id."""
        found: dict[str, dict[str, Any]] = self._ask({'do': 'things'})
        return found

    def clear(self) -> None:
        """Delete all groups, so that the next test begins with nothing."""
        self._ask({'do': 'clear'})
