# SPDX-License-Identifier: Apache-2.0
"""Record requests and answers of the simulated Azure, in the form that oav validates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import json
from pathlib import Path
import re
from typing import Any, NamedTuple
from unittest import mock

from rigs.azure.service import Service

#: Specification files by the first of these words that a path contains, below ``specification/``.
SPECIFICATIONS = {
    '/microsoft.resources/tags/': 'resources/*/Microsoft.Resources/stable/*/resources.json',
    # it has the permissions of a group and of a resource, and not those of a subscription
    '/microsoft.authorization/permissions': '',
    '/microsoft.authorization/roledefinitions':
        'authorization/*/Microsoft.Authorization/stable/*/authorization-RoleDefinitionsCalls.json',
    '/microsoft.authorization/roleassignments':
        'authorization/*/Microsoft.Authorization/stable/*/authorization-RoleAssignmentsCalls.json',
    '/microsoft.devtestlab/': 'devtestlabs/*/Microsoft.DevTestLab/stable/*/DTL.json',
    '/microsoft.compute/virtualmachines':
        'compute/*/Microsoft.Compute/ComputeRP/stable/*/virtualMachine.json',
    '/microsoft.compute/snapshots': 'compute/*/Microsoft.Compute/DiskRP/stable/*/snapshot.json',
    '/microsoft.compute/galleries': 'compute/*/Microsoft.Compute/GalleryRP/stable/*/gallery.json',
    '/microsoft.compute/skus': 'compute/*/Microsoft.Compute/Skus/stable/*/skus.json',
    **{f'/microsoft.network/{name.lower()}': f'network/*/Microsoft.Network/stable/*/{name}.json'
       for name in ('networkSecurityGroup', 'virtualNetwork', 'publicIpAddress',
                    'networkInterface')},
    '/resourcegroups': 'resources/*/Microsoft.Resources/stable/*/resources.json',
}


class Exchange(NamedTuple):
    """A request and its answer; ``target`` is path and query."""

    method: str
    target: str
    body: Any
    status: int
    headers: Mapping[str, str]
    answer: Any

    def shape(self) -> str:
        """Return method, path without names, status, and the members of both bodies."""
        path, _, query = self.target.partition('?')
        plain = re.sub('(?<=/)([0-9a-f-]{36}|(shutdown-computevm-)?fogros2[^/]*)', '{}', path)
        version = re.search('api-version=([0-9-]+)', query)
        return ' '.join(filter(None, (
            self.method, plain, version and version[1], str(self.status),
            ','.join(sorted(_members(self.body))), '->', ','.join(sorted(_members(self.answer))))))

    def specification(self) -> str:
        """Return the pattern of the specification's file; '' for an operation's state."""
        path = self.target.partition('?')[0].lower()
        return '' if 'operation' in path else next(
            (file for word, file in SPECIFICATIONS.items() if word in path), '')

    def pair(self, version: str) -> Mapping[str, Any]:
        """Return oav's form of it, for a specification of ``version``."""
        target = re.sub('api-version=[0-9-]+', f'api-version={version}', self.target)
        kind = {'Content-Type': 'application/json'}
        return {
            'liveRequest': {'method': self.method, 'headers': kind, 'body': self.body or {},
                            'url': f'https://management.azure.com{target}'},
            'liveResponse': {'statusCode': str(self.status), 'headers': {**kind, **self.headers},
                             'body': self.answer if self.answer is not None else {}}}


def _members(value: Any, path: str = '') -> set[str]:
    """Return the paths of all members of a JSON value; tags have names of their own."""
    if isinstance(value, list):
        return set().union(*(_members(item, f'{path}[]') for item in value))
    if not isinstance(value, Mapping) or path.endswith('tags'):
        return {path} - {''}
    return set().union(*(_members(item, f'{path}.{key}'.lstrip('.'))
                         for key, item in value.items())) or {path} - {''}


@contextlib.contextmanager
def recorded(service: Service) -> Iterator[list[Exchange]]:
    """Record what a service is asked and answers."""
    found: list[Exchange] = []
    answer = service.answer

    def recording(method: str, target: str, headers: Mapping[str, str], body: Any) -> Any:
        # a body may change afterwards: the service keeps it
        asked = json.loads(json.dumps(body))
        status, more, said = answer(method, target, headers, body)
        found.append(Exchange(method, target, asked, status, more, json.loads(json.dumps(said))))
        return status, more, said

    with mock.patch.object(service, 'answer', recording):
        yield found


def newest(folder: Path, pattern: str, version: str) -> Path:
    """Return the newest file of a specification up to ``version``."""
    return max((file for file in folder.glob(f'specification/{pattern}')
                if file.parent.name <= version), key=lambda file: file.parent.name)
