# SPDX-License-Identifier: Apache-2.0
"""
Find how WireGuard's UDP gets from the robot to a pod.

By a load balancer, by a port of the nodes, or, if neither lets UDP through, the pod connects to
the robot. WireGuard admits known peers only, so until its agent starts, the pod answers
probes on that port: an address that answers is known to work.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import contextlib
import dataclasses
import re
import secrets
import select
import socket
import threading
import time
from typing import Any, Optional
from urllib.parse import urlsplit

from fogros2.errors import Cancelled

#: Seconds between two probes.
INTERVAL = 0.1
#: Number of probes to one address that may still be answered.
ROUNDS = 10
#: Time-out of a load balancer's creation and first answer, in seconds: clouds need minutes.
LOAD_BALANCER = 180.0
#: The same for load balancers that the cluster itself makes, which may be switched off.
LOAD_BALANCER_INSIDE = 60.0
#: The same where no other way is tried: AWS registers a pod in up to 300 s.
LOAD_BALANCER_ALONE = 420.0
#: Time-out of a node port's first answer, in seconds.
NODE_PORT = 6.0

#: Host names of API servers of clouds that make load balancers.
_SERVERS = {r'\.eks\.amazonaws\.com(\.cn)?$': 'EKS', r'\.azmk8s\.io$': 'AKS',
            r'\.gke\.goog$': 'GKE', r'\.k8s\.ondigitalocean\.com$': 'DigitalOcean'}
#: Suffixes of API groups of these clouds, and of load balancers for other clusters.
_GROUPS = {'metallb.io': 'MetalLB', 'purelb.io': 'PureLB', 'loxilb.io': 'LoxiLB',
           'gke.io': 'GKE', 'k8s.aws': 'EKS', 'amazonaws.com': 'EKS', 'azmk8s.io': 'AKS',
           'k3s.cattle.io': 'k3s'}
#: Load balancers without a cloud.
_INSIDE = ('MetalLB', 'PureLB', 'LoxiLB', 'k3s')


@dataclasses.dataclass(frozen=True)
class Exposure:
    """
    How UDP reaches a pod.

    :param kind: one of ``options.EXPOSURES``.
    :param host: address of the pod for the robot, '' if the pod connects to the robot.
    :param port: UDP port, 0 for the VPN's own.
    :param why: the reason, for people.
    """

    kind: str
    host: str = ''
    port: int = 0
    why: str = ''

    def __str__(self) -> str:
        return f'{self.kind} {self.host or "-"} {self.port} {self.why}'

    def words(self) -> str:
        """Describe the exposure and its reason, for people."""
        return f'UDP by {self.kind}: {self.why}' if self.why else f'UDP by {self.kind}'

    @classmethod
    def parse(cls, text: str) -> Optional[Exposure]:
        """Parse the result of ``str``; return None for another text."""
        words = text.split(' ', 3)
        if len(words) < 3 or not words[2].isdecimal():
            return None
        return cls(words[0], '' if words[1] == '-' else words[1], int(words[2]),
                   words[3] if len(words) > 3 else '')


def load_balancers(server: str, groups: Iterable[str] = ()) -> str:
    """
    Return the name of what makes load balancers in a cluster, '' if nothing is known to.

    Without it, a Service of type LoadBalancer would never get an address.

    :param server: URL of the API server.
    :param groups: API groups of the cluster.
    """
    host = urlsplit(server).hostname or ''
    for pattern, name in _SERVERS.items():
        if re.search(pattern, host):
            return name
    return next((name for end, name in _GROUPS.items() for group in groups
                 if group == end or group.endswith(f'.{end}')), '')


def timeout(maker: str) -> float:
    """Return the time-out of a load balancer in seconds, by what makes it."""
    return LOAD_BALANCER_INSIDE if maker in _INSIDE else LOAD_BALANCER


def ingress(service: Mapping[str, Any]) -> list[str]:
    """Return the addresses and host names of a load balancer; none before it is ready."""
    entries = ((service.get('status') or {}).get('loadBalancer') or {}).get('ingress') or ()
    return [str(each.get('ip') or each.get('hostname')) for each in entries
            if each.get('ip') or each.get('hostname')]


def node_port(service: Mapping[str, Any]) -> int:
    """Return the node port of a Service, 0 if it has none."""
    return int(service['spec']['ports'][0].get('nodePort') or 0)


def node_addresses(node: Mapping[str, Any]) -> list[str]:
    """Return a node's addresses, external ones first."""
    entries = (node.get('status') or {}).get('addresses') or ()
    order = ('ExternalIP', 'InternalIP')
    return [str(each['address']) for kind in order for each in entries if each['type'] == kind]


def first_to_answer(
    places: Sequence[tuple[str, int]], word: str, *, timeout: float,
    cancel: Optional[threading.Event] = None,
) -> Optional[tuple[str, int]]:
    """
    Return the first of several (host, port) at which the pod answers, None if none does.

    :param word: first word of the probes; the pod answers no others.
    :raises Cancelled: ``cancel`` was set.
    """
    question = word.encode() + b' ' + secrets.token_hex(8).encode()
    deadline = time.monotonic() + timeout
    endpoints = _resolved(places)
    links: dict[socket.socket, tuple[str, int]] = {}
    try:
        while endpoints and time.monotonic() < deadline:
            if cancel is not None and cancel.is_set():
                raise Cancelled('looking for a way into the cluster')
            # Each probe has a new source port: a node forwards all datagrams of a connection as
            # the first one, which it may have received before it knew the pod.
            for place in endpoints:
                with contextlib.suppress(OSError):
                    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                    links[link] = place
                    link.setblocking(False)
                    link.connect(place)  # receive datagrams only from this address
                    link.send(question)
            begin = time.monotonic()
            while (remaining := begin + INTERVAL - time.monotonic()) > 0:
                poll = select.poll()  # unlike select(), it takes descriptors above 1023
                for link in links:
                    poll.register(link, select.POLLIN)
                ready = {number for number, _ in poll.poll(1000 * remaining)}
                for link in [link for link in links if link.fileno() in ready]:
                    place = links[link]
                    with contextlib.suppress(OSError):
                        if link.recv(512) == question:
                            return place
                    # A node that is not ready refused the datagram.
                    del links[link]
                    link.close()
            for link in list(links)[:-ROUNDS * len(endpoints)]:
                del links[link]
                link.close()
    finally:
        for link in links:
            link.close()
    return None


def _resolved(places: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return places by address, without unknown host names."""
    endpoints = []
    for host, port in places:
        with contextlib.suppress(OSError):
            address = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
            endpoints.append((str(address[0]), port))
    return endpoints
