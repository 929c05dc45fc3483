# SPDX-License-Identifier: Apache-2.0
"""Namespaces of a test's own, in which a user has a role and no other right."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
from pathlib import Path
import secrets
from typing import Any

import yaml

from fogros2.waiting import wait_until
from rigs.cluster.client import Client
from rigs.cluster.cluster import Cluster


@dataclasses.dataclass(frozen=True)
class Namespace:
    """
    A namespace of a test's own.

    :param kubeconfig: of the user 'robot', whose role here is the sample one.
    """

    name: str
    client: Client
    kubeconfig: Path

    def all(self, kind: str) -> list[dict[str, Any]]:
        """Return the objects of a kind: pods, services, jobs, events, ..."""
        group = '/apis/batch/v1' if kind == 'jobs' else '/api/v1'
        found: list[dict[str, Any]] = self.client.ask(
            'GET', f'{group}/namespaces/{self.name}/{kind}')['items']
        return found

    def left(self) -> list[str]:
        """Return what a machine may leave, one line each."""
        own = [('secrets', 'default-token'), ('configmaps', 'kube-root-ca')]
        return [f"{kind} {one['metadata']['name']}"
                for kind in ('jobs', 'pods', 'services', 'secrets', 'configmaps')
                for one in self.all(kind)
                if not any(kind == k and one['metadata']['name'].startswith(n) for k, n in own)]

    def gone(self, timeout: float = 30.0) -> None:
        """Wait until nothing is left."""
        try:
            wait_until(lambda: not self.left() or None, timeout=timeout,
                       what='the namespace to be empty')
        except RuntimeError as error:
            raise AssertionError(f'left in the namespace: {self.left()}') from error


def role(text: str, namespace: str) -> dict[str, Any]:
    """Return the Role of a YAML text for a namespace."""
    (found,) = [part for part in yaml.safe_load_all(text) if part and part['kind'] == 'Role']
    found['metadata']['namespace'] = namespace
    return dict(found)


@contextlib.contextmanager
def making_namespaces(
    cluster: Cluster, client: Client, role_file: Path,
) -> Iterator[Callable[..., Namespace]]:
    """
    Yield what makes a namespace in which a user has a role, or a changed one; gone at the end.

    :param role_file: YAML with one Role, whichever namespace it is for.
    """
    made: list[str] = []

    def make(
        change: Callable[[dict[str, Any]], None] = lambda role: None,
    ) -> Namespace:
        name = f'it-{secrets.token_hex(3)}'
        client.create('/api/v1/namespaces', 'v1 Namespace', name)
        made.append(name)
        rights = role(role_file.read_text(), name)
        change(rights)
        base = f'/apis/rbac.authorization.k8s.io/v1/namespaces/{name}'
        client.ask('POST', f'{base}/roles', rights)
        client.create(
            f'{base}/rolebindings', 'rbac.authorization.k8s.io/v1 RoleBinding', 'robot',
            subjects=[{'kind': 'User', 'name': 'robot', 'apiGroup': 'rbac.authorization.k8s.io'}],
            roleRef={'kind': 'Role', 'name': rights['metadata']['name'],
                     'apiGroup': 'rbac.authorization.k8s.io'})
        wait_until(lambda: client.ask(
            'GET', f'/api/v1/namespaces/{name}/serviceaccounts')['items'] or None,
            timeout=30.0, what="the namespace's service account")
        return Namespace(name, client, cluster.kubeconfig_of_robot(name))

    try:
        yield make
    finally:
        for name in made:
            client.ask('DELETE', f'/api/v1/namespaces/{name}')
