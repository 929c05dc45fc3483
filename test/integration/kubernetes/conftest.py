# SPDX-License-Identifier: Apache-2.0
"""A real cluster for all tests of this folder, and a namespace with a robot's rights for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import subprocess

import pytest

from fogros2 import store
from rigs.cluster import Client, Cluster, cluster, running_cluster
from rigs.cluster.namespaces import making_namespaces, Namespace

ROOT = Path(__file__).resolve().parents[3]
ROLE = ROOT / 'packaging' / 'kubernetes' / 'role.yaml'


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each test here time for the cluster's images, which the first one waits for."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(900))


@pytest.fixture(scope='session')
def binaries(root: None) -> Path:
    """Return the folder of Kubernetes's programs, skip where there is none."""
    script = ROOT / 'tools' / 'kubernetes.sh'
    found = subprocess.run([script, '--find'], capture_output=True, text=True, check=True)
    if not found.stdout:
        pytest.skip("needs Kubernetes: 'make test-kubernetes' builds it (six minutes, once)")
    return Path(found.stdout.strip())


@pytest.fixture(scope='session', autouse=True)
def keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the files with this process's keys, which the client writes once, for all tests."""
    folder = tmp_path_factory.mktemp('keys')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, 'process_folder', lambda: folder)
        yield


@pytest.fixture(scope='session')
def kubernetes(binaries: Path) -> Iterator[Cluster]:
    """Return a cluster of this run's own, or the one that FOGROS2_CLUSTER names."""
    if folder := os.environ.get('FOGROS2_CLUSTER'):
        yield running_cluster(Path(folder))
        return
    pytest.importorskip('kubernetes', reason='needs the client: pip install kubernetes')
    with cluster(binaries.parent, binaries) as running:
        yield running


@pytest.fixture(scope='session')
def client(kubernetes: Cluster) -> Client:
    """Return the administrator's access to the API."""
    return Client(kubernetes.kubeconfig)


@pytest.fixture
def namespaces(kubernetes: Cluster, client: Client) -> Iterator[Callable[..., Namespace]]:
    """Return what makes a namespace, gone after the test."""
    with making_namespaces(kubernetes, client, ROLE) as make:
        yield make


@pytest.fixture(scope='module')
def namespaces_of_module(
    kubernetes: Cluster, client: Client,
) -> Iterator[Callable[..., Namespace]]:
    """Return what makes a namespace, gone after the module."""
    with making_namespaces(kubernetes, client, ROLE) as make:
        yield make


@pytest.fixture
def namespace(
    namespaces: Callable[..., Namespace], monkeypatch: pytest.MonkeyPatch,
) -> Namespace:
    """Return a namespace that this test's robot uses, with no right beyond the sample role."""
    made = namespaces()
    monkeypatch.setenv('KUBECONFIG', str(made.kubeconfig))
    return made
