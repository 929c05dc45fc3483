# SPDX-License-Identifier: Apache-2.0
"""A real Kubernetes cluster of one node, for the time of a test."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import ipaddress
import json
import os
from pathlib import Path
import secrets
from typing import Any, Optional

from fogros2 import process
from fogros2.model import Command, Result
from rigs.cluster import certificates, images, node, services
from rigs.cluster.client import Client
from rigs.cluster.node_process import ask, ClusterError, run_node
from rigs.cluster.pod_security import make_policies

#: Users besides the administrator; none has a right until somebody gives it one.
USERS = ('robot',)
#: Networks for the cable between computer and node. Of TEST-NET-2, the last ones: the tests'
#: container networks take the first.
CABLES = [f'198.51.100.{last}/30' for last in (252, 248, 244, 240)]
#: What ``running_cluster`` has to know, in the cluster's folder.
_OWN = 'cluster.json'


@dataclasses.dataclass(frozen=True)
class Cluster:
    """
    A running cluster.

    :param folder: holds kubeconfig files, ``admin.conf`` and one for each user, and ``log/``.
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

    def kubeconfig_of(self, user: str, namespace: str = 'default') -> Path:
        """Return a kubeconfig file of a user (see ``USERS``) for a namespace."""
        path = self.folder / f'{user}-{namespace}.conf'
        config = json.loads((self.folder / f'{user}.conf').read_text())
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
    say: Callable[[str], None] = print,
) -> Iterator[Cluster]:
    """
    Run a cluster for the time of the block.

    The first one of a computer takes a minute or two to make its images, others take seconds.

    :param cache: a folder for images, and for all nodes that run.
    :param binaries: folder with Kubernetes's programs, see ``tools/kubernetes.sh``.
    :param store: another cluster's ``images``; those of today's sources unless given.
    :param say: gets a line before something slow begins.
    :raises ClusterError: it didn't come up.
    """
    store = store or images.store(cache, binaries, say)
    network = free_network()
    host, there = network.hosts()
    layout = services.Layout(str(there), str(host), network.prefixlen)
    authority = certificates.Authority("FogROS2's tests")
    api = authority.issue('kube-apiserver', [layout.node, '127.0.0.1', 'localhost'])
    kubelet = authority.issue(services.NODE, [layout.node, services.NODE])
    users = {
        'admin': (secrets.token_hex(16), ('system:masters',)),
        'cluster': (secrets.token_hex(16), ('system:masters',)),
        f'system:node:{services.NODE}': (secrets.token_hex(16), ('system:nodes',)),
        **{name: (secrets.token_hex(16), ()) for name in USERS},
    }
    trusted = base64.b64encode(authority.certificate).decode()

    def access(user: str) -> str:
        return services.kubeconfig(layout.server, trusted, user, users[user][0])

    runs = cache / 'runs'
    run_folder_mark = secrets.token_hex(3)
    files = {
        **services.files(layout, images.SANDBOX, node.MARK + run_folder_mark),
        'ca.crt': authority.certificate.decode(),
        'api.crt': api.certificate.decode(), 'api.key': api.key.decode(),
        'kubelet.crt': kubelet.certificate.decode(), 'kubelet.key': kubelet.key.decode(),
        'accounts.key': certificates.rsa_key().decode(),
        'tokens.csv': services.tokens(users),
        'admin.conf': access('admin'), 'cluster.conf': access('cluster'),
        'node.conf': access(f'system:node:{services.NODE}'),
        **{f'{name}.conf': access(name) for name in USERS},
        _OWN: json.dumps({'layout': dataclasses.asdict(layout), 'images': str(store)}),
    }
    started = run_node(runs, {
        'commands': services.commands(layout), 'binaries': str(binaries / 'bin'),
        'images': str(store), 'server': layout.server, 'pods': layout.pods,
        'authority': authority.certificate.decode(), 'token': users['cluster'][0],
        'cable': {'name': f'fogt{run_folder_mark}',
                  'host': f'{layout.host}/{layout.prefix}',
                  'node': f'{layout.node}/{layout.prefix}'},
    }, files, name=run_folder_mark)
    try:
        if started.await_line(120.0) is None:
            raise ClusterError('the node ended before it had begun')
        running = Cluster(started.folder, layout, store)
        make_policies(Client(running.kubeconfig))
        yield running
    finally:
        started.stop()


def running_cluster(folder: Path) -> Cluster:
    """Return the cluster that another process runs, see ``python -m rigs.cluster``."""
    own = json.loads((folder / _OWN).read_text())
    return Cluster(folder, services.Layout(**own['layout']), Path(own['images']))


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
