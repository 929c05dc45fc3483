# SPDX-License-Identifier: Apache-2.0
"""A real Kubernetes cluster of one node, for the time of a test."""

from __future__ import annotations

import base64
from collections.abc import Iterator
import contextlib
import dataclasses
import ipaddress
import json
import os
from pathlib import Path
import secrets
import tempfile
from typing import Any, Optional

from fogros2 import process
from fogros2.model import Command, Result
from rigs.cluster import images, node, services
from rigs.cluster.node_process import ask, ClusterError, run_node

#: Networks for the cable between computer and node. Of TEST-NET-2, the last ones: the tests'
#: container networks take the first.
CABLES = [f'198.51.100.{last}/30' for last in (252, 248, 244, 240)]
#: What ``running_cluster`` has to know, in the cluster's folder.
_OWN = 'cluster.json'


@dataclasses.dataclass(frozen=True)
class Cluster:
    """
    A running cluster.

    :param folder: holds kubeconfig files, ``admin.conf`` and ``robot.conf``, and ``log/``.
    :param images: containerd's folder that it began with; another cluster may as well.
    """

    folder: Path
    layout: services.Layout
    images: Path

    @property
    def kubeconfig(self) -> Path:
        """Return the administrator's kubeconfig file."""
        return self.folder / 'admin.conf'

    @property
    def why_not_ready(self) -> str:
        """Return why ``READY`` has nothing that a launch of this robot needs, '' if it has."""
        return images.why_not_ready(self.images)

    def kubeconfig_of_robot(self, namespace: str) -> Path:
        """Return a kubeconfig file for a namespace, of a user without a right of its own."""
        path = self.folder / f'robot-{namespace}.conf'
        config = json.loads((self.folder / 'robot.conf').read_text())
        config['contexts'][0]['context']['namespace'] = namespace
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), 'w') as file:
            file.write(json.dumps(config))
        return path

    def stop(self, service: str) -> None:
        """Kill a service of the node, such as ``kube-apiserver``, and leave it so."""
        ask(self.folder, {'stop': service})

    def start(self, service: str) -> None:
        """Start a service that was stopped, and wait until it answers again."""
        ask(self.folder, {'start': service})

    def run(self, *words: str) -> Result:
        """Run a program in the node's namespaces, as root."""
        reply = ask(self.folder, {'run': list(words)})
        return Result(reply['returncode'], reply['stdout'], reply['stderr'])

    def requests(self, user: str) -> list[dict[str, Any]]:
        """Return the API server's audit lines for the requests of a user, each once."""
        text = self.run('cat', f'{services.HERE}/log/audit.json').stdout
        events = [json.loads(line) for line in text.splitlines()]
        return [event for event in events
                if event['stage'] == 'RequestReceived' and event['user']['username'] == user]


@contextlib.contextmanager
def cluster(
    cache: Path, binaries: Path, *, store: Optional[Path] = None,
) -> Iterator[Cluster]:
    """
    Run a cluster for the time of the block.

    The first one of a computer takes a minute or two to make its images, others take seconds.

    :param cache: a folder for images, and for all nodes that run.
    :param binaries: folder with Kubernetes's programs, see ``tools/kubernetes.sh``.
    :param store: another cluster's ``images``; those of today's sources unless given.
    :raises ClusterError: it didn't come up.
    """
    store = store or images.store(cache, binaries)
    network = free_network()
    host, there = network.hosts()
    layout = services.Layout(str(there), str(host), network.prefixlen)
    key, certificate = key_pair(f'IP:{layout.node},IP:127.0.0.1,DNS:{services.NODE}')
    users = {
        'admin': (secrets.token_hex(16), ('system:masters',)),
        'cluster': (secrets.token_hex(16), ('system:masters',)),
        f'system:node:{services.NODE}': (secrets.token_hex(16), ('system:nodes',)),
        'robot': (secrets.token_hex(16), ()),
    }
    trusted = base64.b64encode(certificate.encode()).decode()

    def access(user: str) -> str:
        return services.kubeconfig(layout.server, trusted, user, users[user][0])

    runs = cache / 'runs'
    run_folder_mark = secrets.token_hex(3)
    files = {
        **services.files(layout, images.SANDBOX, node.MARK + run_folder_mark),
        'tls.crt': certificate, 'tls.key': key,
        'tokens.csv': services.tokens(users),
        'admin.conf': access('admin'), 'cluster.conf': access('cluster'),
        'node.conf': access(f'system:node:{services.NODE}'),
        'robot.conf': access('robot'),
        _OWN: json.dumps({'layout': dataclasses.asdict(layout), 'images': str(store)}),
    }
    started = run_node(runs, {
        'commands': services.commands(layout), 'binaries': str(binaries / 'bin'),
        'images': str(store), 'server': layout.server, 'pods': layout.pods,
        'authority': certificate, 'token': users['cluster'][0],
        'cable': {'name': f'fogt{run_folder_mark}',
                  'host': f'{layout.host}/{layout.prefix}',
                  'node': f'{layout.node}/{layout.prefix}'},
    }, files, name=run_folder_mark)
    try:
        if started.await_line(120.0) is None:
            raise ClusterError('the node ended before it had begun')
        yield Cluster(started.folder, layout, store)
    finally:
        started.stop()


def running_cluster(folder: Path) -> Cluster:
    """Return the cluster that another process runs, see ``python -m rigs.cluster``."""
    own = json.loads((folder / _OWN).read_text())
    return Cluster(folder, services.Layout(**own['layout']), Path(own['images']))


def key_pair(names: str) -> tuple[str, str]:
    """
    Return a new key and its certificate, PEM, valid for a day: for all services of a cluster.

    :param names: what the services are reached by, as in ``subjectAltName``.
    """
    with tempfile.TemporaryDirectory() as folder:
        key, certificate = Path(folder, 'key'), Path(folder, 'certificate')
        process.run(Command((
            'openssl', 'req', '-x509', '-newkey', 'rsa:2048', '-nodes', '-days', '1',
            '-subj', "/CN=FogROS2's tests", '-addext', f'subjectAltName={names}',
            '-addext', 'extendedKeyUsage=serverAuth,clientAuth',
            '-keyout', str(key), '-out', str(certificate))), timeout=60.0)
        return key.read_text(), certificate.read_text()


def free_network() -> ipaddress.IPv4Network:
    """
    Return a network for a cable that this computer has no address or route in.

    :raises ClusterError: all are taken.
    """
    routes = json.loads(process.run(Command(('ip', '-j', 'route', 'show', 'table', 'all')),
                                    timeout=60.0).stdout)
    taken = [ipaddress.ip_network(route['dst'], strict=False) for route in routes
             if route.get('dst', 'default') != 'default' and ':' not in route['dst']]
    for text in CABLES:
        network = ipaddress.IPv4Network(text)
        if not any(network.overlaps(other) for other in taken):
            return network
    raise ClusterError(f'none of {", ".join(CABLES)} is free for a cluster')
