# SPDX-License-Identifier: Apache-2.0
"""
How WireGuard's UDP gets from the robot to a pod.

A load balancer, a port of the nodes, or, where neither lets UDP through, the pod dials the robot.
WireGuard answers nobody it doesn't know, so the pod answers a question of ours on that port until
its agent comes: what answers is known to work.
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

#: Seconds between two questions.
INTERVAL = 0.1
#: Questions to one place that may still be answered.
ROUNDS = 10
#: Seconds in which a load balancer has to be there, and to answer: clouds take minutes.
LOAD_BALANCER = 180.0
#: The same where it is made within the cluster: some of those who could are switched off.
LOAD_BALANCER_INSIDE = 60.0
#: Seconds in which a port of a node that is going to answer does.
NODE_PORT = 6.0

#: Names of API servers that tell whose cluster it is, and that it makes load balancers.
_SERVERS = {r'\.eks\.amazonaws\.com(\.cn)?$': 'EKS', r'\.azmk8s\.io$': 'AKS',
            r'\.gke\.goog$': 'GKE', r'\.k8s\.ondigitalocean\.com$': 'DigitalOcean'}
#: Ends of API groups that tell the same, and of what makes them in clusters of one's own.
_GROUPS = {'metallb.io': 'MetalLB', 'purelb.io': 'PureLB', 'loxilb.io': 'LoxiLB',
           'gke.io': 'GKE', 'k8s.aws': 'EKS', 'amazonaws.com': 'EKS', 'azmk8s.io': 'AKS',
           'k3s.cattle.io': 'k3s'}
#: Those who make them without a cloud.
_INSIDE = ('MetalLB', 'PureLB', 'LoxiLB', 'k3s')


@dataclasses.dataclass(frozen=True)
class Exposure:
    """
    The way that was found.

    :param kind: one of ``options.EXPOSURES``.
    :param host: where the robot reaches the pod, '' where the pod dials the robot.
    :param port: UDP port there, 0 for the VPN's own.
    :param why: in a few words, for people.
    """

    kind: str
    host: str = ''
    port: int = 0
    why: str = ''

    def __str__(self) -> str:
        return f'{self.kind} {self.host or "-"} {self.port} {self.why}'

    def words(self) -> str:
        """Return which way was taken and why, for people."""
        return f'UDP by {self.kind}: {self.why}' if self.why else f'UDP by {self.kind}'

    @classmethod
    def parse(cls, text: str) -> Optional[Exposure]:
        """Return what ``str`` has written down, None if it is no such text."""
        words = text.split(' ', 3)
        if len(words) < 3 or not words[2].isdigit():
            return None
        return cls(words[0], '' if words[1] == '-' else words[1], int(words[2]),
                   words[3] if len(words) > 3 else '')


def load_balancers(server: str, groups: Iterable[str] = ()) -> str:
    """
    Return who makes load balancers in a cluster, '' if nobody is known to.

    Asking for one where nobody makes any means waiting in vain.

    :param server: URL of its API server.
    :param groups: the API groups it has.
    """
    host = urlsplit(server).hostname or ''
    for pattern, name in _SERVERS.items():
        if re.search(pattern, host):
            return name
    return next((name for end, name in _GROUPS.items() for group in groups
                 if group == end or group.endswith(f'.{end}')), '')


def patience(maker: str) -> float:
    """Return the seconds for which a load balancer is waited for, by who makes it."""
    return LOAD_BALANCER_INSIDE if maker in _INSIDE else LOAD_BALANCER


def ingress(service: Mapping[str, Any]) -> list[str]:
    """Return the addresses and names of a load balancer, once it has some."""
    found = ((service.get('status') or {}).get('loadBalancer') or {}).get('ingress') or ()
    return [str(each.get('ip') or each.get('hostname')) for each in found
            if each.get('ip') or each.get('hostname')]


def node_port(service: Mapping[str, Any]) -> int:
    """Return the port of the nodes that leads to the pod, 0 if there is none."""
    return int(service['spec']['ports'][0].get('nodePort') or 0)


def node_addresses(node: Mapping[str, Any]) -> list[str]:
    """Return a node's addresses, those for outside first."""
    found = (node.get('status') or {}).get('addresses') or ()
    order = ('ExternalIP', 'InternalIP')
    return [str(each['address']) for kind in order for each in found if each['type'] == kind]


def first_to_answer(
    places: Sequence[tuple[str, int]], word: str, *, timeout: float,
    cancel: Optional[threading.Event] = None,
) -> Optional[tuple[str, int]]:
    """
    Return the first of several (host, port) at which the pod answers, None if none does.

    :param word: what the pod listens for.
    :raises Cancelled: ``cancel`` was set.
    """
    question = word.encode() + b' ' + secrets.token_hex(8).encode()
    deadline = time.monotonic() + timeout
    known = _resolved(places)
    links: dict[socket.socket, tuple[str, int]] = {}
    try:
        while known and time.monotonic() < deadline:
            if cancel is not None and cancel.is_set():
                raise Cancelled('looking for a way into the cluster')
            # From a port of its own each time: the node remembers what became of the first
            # datagram of a pair of ports, and that may have been before it knew the pod.
            for place in known:
                with contextlib.suppress(OSError):
                    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                    links[link] = place
                    link.setblocking(False)
                    link.connect(place)  # another's datagram isn't taken for an answer
                    link.send(question)
            begin = time.monotonic()
            while (left := begin + INTERVAL - time.monotonic()) > 0:
                ready, _, _ = select.select(list(links), [], [], left)
                for link in ready:
                    place = links[link]
                    with contextlib.suppress(OSError):
                        if link.recv(512) == question:
                            return place
                    # refused, by a node that isn't ready
                    del links[link]
                    link.close()
            for link in list(links)[:-ROUNDS * len(known)]:
                del links[link]
                link.close()
    finally:
        for link in links:
            link.close()
    return None


def _resolved(places: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return places by address, without those whose name nobody knows (yet)."""
    found = []
    for host, port in places:
        with contextlib.suppress(OSError):
            address = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
            found.append((str(address[0]), port))
    return found


def own_address(server: str) -> str:
    """Return the address from which this computer speaks with an API server, '' if it can't."""
    parts = urlsplit(server)
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect((parts.hostname or '', parts.port or 443))
        return str(link.getsockname()[0])
    return ''
