# SPDX-License-Identifier: Apache-2.0
"""A real cluster for all tests of this folder, and a namespace with a robot's rights for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import os
from pathlib import Path
import secrets
import subprocess
from typing import Any, Optional

import pytest

from fogros2.testing.cluster import Client, Cluster, cluster, running_cluster
from fogros2.waiting import wait_until

ROOT = Path(__file__).resolve().parents[3]
ROLE = ROOT / 'deploy' / 'kubernetes' / 'role.yaml'


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each test here time for the cluster's images, which the first one waits for."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(300))


@pytest.fixture(scope='session')
def binaries(root: None) -> Path:
    """Return the folder of Kubernetes's programs, skip where there is none."""
    # tools/test.sh has tried to build them
    if reason := os.environ.get('FOGROS2_NO_KUBERNETES'):
        pytest.skip(reason)
    script = ROOT / 'tools' / 'kubernetes.sh'
    found = subprocess.run([script, '--find'], capture_output=True, text=True, check=True)
    if not found.stdout:
        pytest.skip("needs Kubernetes: 'make test-kubernetes' builds it (ten minutes, once)")
    return Path(found.stdout.strip())


@pytest.fixture(scope='session')
def kubernetes(binaries: Path) -> Iterator[Cluster]:
    """Return a cluster of this run's own, or the one that FOGROS2_CLUSTER names."""
    if folder := os.environ.get('FOGROS2_CLUSTER'):
        yield running_cluster(Path(folder))
        return
    pytest.importorskip('kubernetes', reason="needs the client: pip install 'fogros2[kubernetes]'")
    with cluster(binaries.parent, binaries) as running:
        yield running


@pytest.fixture(scope='session')
def client(kubernetes: Cluster) -> Client:
    """Return the administrator's access to the API."""
    return Client(kubernetes.kubeconfig)


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
    """Return the sample Role for a namespace."""
    import yaml

    (found,) = [part for part in yaml.safe_load_all(text) if part and part['kind'] == 'Role']
    found['metadata']['namespace'] = namespace
    return dict(found)


@contextlib.contextmanager
def making_namespaces(kubernetes: Cluster, client: Client) -> Iterator[Callable[..., Namespace]]:
    """Yield what makes a namespace in which a user has the sample role, or a changed one."""
    made: list[str] = []

    def make(
        change: Callable[[dict[str, Any]], None] = lambda role: None, *, user: str = 'robot',
        labels: Optional[dict[str, str]] = None,
    ) -> Namespace:
        name = f'it-{secrets.token_hex(3)}'
        client.create('/api/v1/namespaces', 'v1 Namespace', name,
                      metadata={'labels': labels or {}})
        made.append(name)
        rights = role(ROLE.read_text(), name)
        change(rights)
        base = f'/apis/rbac.authorization.k8s.io/v1/namespaces/{name}'
        client.ask('POST', f'{base}/roles', rights)
        client.create(
            f'{base}/rolebindings', 'rbac.authorization.k8s.io/v1 RoleBinding', 'robot',
            subjects=[{'kind': 'User', 'name': user, 'apiGroup': 'rbac.authorization.k8s.io'}],
            roleRef={'kind': 'Role', 'name': rights['metadata']['name'],
                     'apiGroup': 'rbac.authorization.k8s.io'})
        wait_until(lambda: client.ask(
            'GET', f'/api/v1/namespaces/{name}/serviceaccounts')['items'] or None,
            timeout=30.0, what="the namespace's service account")
        return Namespace(name, client, kubernetes.kubeconfig_of(user, name))

    try:
        yield make
    finally:
        for name in made:
            client.ask('DELETE', f'/api/v1/namespaces/{name}')


@pytest.fixture
def namespaces(kubernetes: Cluster, client: Client) -> Iterator[Callable[..., Namespace]]:
    """Return what makes a namespace, gone after the test."""
    with making_namespaces(kubernetes, client) as make:
        yield make


@pytest.fixture(scope='module')
def namespaces_of_module(
    kubernetes: Cluster, client: Client,
) -> Iterator[Callable[..., Namespace]]:
    """Return what makes a namespace, gone after the module."""
    with making_namespaces(kubernetes, client) as make:
        yield make


@pytest.fixture
def namespace(
    namespaces: Callable[..., Namespace], monkeypatch: pytest.MonkeyPatch,
) -> Namespace:
    """Return a namespace that this test's robot uses, with no right beyond the sample role."""
    made = namespaces()
    monkeypatch.setenv('KUBECONFIG', str(made.kubeconfig))
    return made
