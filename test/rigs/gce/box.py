# SPDX-License-Identifier: Apache-2.0
"""Compute Engine in a box as a test holds it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from rigs.computers.box import Box
from rigs.gce import keys


class GceBox(Box):
    """
    Compute Engine in a box: its REST API, and for each instance a container that is its computer.

    It takes ``google-api-python-client`` for Google's description of the API, besides what every
    box takes.

    :param project: id of the project.
    """

    SERVER: ClassVar[str] = 'rigs.gce.server'
    REGIONS: ClassVar[Sequence[str]] = ('us-central1', 'europe-west3')

    def __init__(self, *, project: str = 'robots', **words: Any) -> None:
        super().__init__(**words)
        self.project = project
        self._key, _ = keys.pair()
        self._settings.update(key=self._key, project=project)

    def environment(self, folder: Path) -> dict[str, str]:
        """
        Return the variables by which programs on the robot take the box for Google Cloud.

        :param folder: gets the key file of their account.
        """
        return {
            'GOOGLE_APPLICATION_CREDENTIALS': str(
                keys.write(folder / 'key.json', self._key, self.inside, self.project)),
            'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE': f'{self.inside}/compute/v1/'}

    def here(self, folder: Path) -> dict[str, str]:
        """Return the same for this process, which reaches the box by the loopback."""
        return {
            'GOOGLE_APPLICATION_CREDENTIALS': str(
                keys.write(folder / 'here.json', self._key, self.endpoint, self.project)),
            'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE': f'{self.endpoint}/compute/v1/'}

    def things(self) -> dict[str, list[str]]:
        """Return the names of what exists in the project, by kind."""
        return {kind: names for kind, names in self._ask({'do': 'things'}).items() if names}

    def clear(self) -> None:
        """Delete everything, for the next test."""
        self._ask({'do': 'clear'})

    def firewall(self, name: str) -> dict[str, Any]:
        """Return a firewall rule."""
        found: dict[str, Any] = self._ask({'do': 'firewall', 'name': name})
        return found
