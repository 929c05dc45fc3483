# SPDX-License-Identifier: Apache-2.0
"""The API on the loopback, without computers: for tests that make no machine."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
from pathlib import Path
from typing import Any

from rigs import serving
from rigs.gce import keys
from rigs.gce.api import Api
from rigs.gce.cloud import Hollow
from rigs.gce.resources import Project


class Loopback:
    """
    An API on the loopback.

    :param url: the server; ``endpoint`` is the API there.
    :param variables: the environment of programs that use it.
    """

    def __init__(self, api: Api, url: str, variables: dict[str, str]) -> None:
        self.api = api
        self.project = api.project
        self.url = url
        self.endpoint = f'{url}/compute/v1/'
        self.variables = variables

    @property
    def instances(self) -> list[dict[str, Any]]:
        """The instances that exist."""
        self.project._prune()
        return list(self.project.instances.values())

    @property
    def own_firewalls(self) -> list[dict[str, Any]]:
        """The firewall rules besides Google's own."""
        return [rule for name, rule in self.project.firewalls.items()
                if not name.startswith('default-')]


@contextlib.contextmanager
def serve(folder: Path) -> Iterator[Loopback]:
    """
    Serve an empty project.

    :param folder: gets the key file.
    """
    private, public = keys.pair()
    api = Api(Project(Hollow(), delay=0.01, linger=0.1), public)
    with contextlib.closing(api.project.cloud), serving.serve(api) as url:
        yield Loopback(api, url, {
            'GOOGLE_APPLICATION_CREDENTIALS': str(keys.write(folder / 'key.json', private, url)),
            'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE': f'{url}/compute/v1/'})
