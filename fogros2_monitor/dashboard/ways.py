# SPDX-License-Identifier: Apache-2.0
"""Decide which topics cross the VPN, by the names of their nodes; pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
import re
from typing import Optional

from fogros2.ros_names import identifier

#: Node names of :func:`fogros2_features.streams.topics.names_of`.
_ENCODER = re.compile(r'(?P<topic>\w+)_(?P<transport>[a-z0-9]+)_encoder(?:_on_(?P<host>\w+))?')
_DECODER = re.compile(r'(?P<topic>\w+)_(?P<transport>[a-z0-9]+)_decoder'
                      r'(?:_from_(?P<source>\w+?))?(?:_on_(?P<host>\w+))?')
#: Topics that every node has, and auxiliary topics of a stream.
_HIDDEN = re.compile(r'/rosout|/parameter_events|.*/_.*|_.*')
_OF_STREAM = ('keyframe', 'feedback', 'pieces', 'slices', 'acknowledged', 'camera_info', 'link',
              'share')
#: Types that are too large for a measurement of the rate: if a node is not where its name says,
#: such a topic might cross the VPN only because of the measurement.
_LARGE = frozenset({'sensor_msgs/msg/Image', 'sensor_msgs/msg/PointCloud2',
                    'sensor_msgs/msg/PointCloud', 'nav_msgs/msg/OccupancyGrid'})
#: Name of the dashboard's own node.
OWN = '_fogros2_dashboard'


@dataclasses.dataclass(frozen=True)
class Topic:
    """A topic of the graph: its type, and the names of its publishers and subscribers."""

    name: str
    kind: str
    publishers: frozenset[str]
    subscribers: frozenset[str]


@dataclasses.dataclass(frozen=True)
class Stream:
    """
    A streamed topic.

    :param topic: name in the launch file.
    :param between: the encoded topic, which crosses the VPN.
    :param source: sending machine, '' for the robot; ``target`` is the receiving one.
    :param heard: whether the encoded topic has a subscriber.
    """

    topic: str
    transport: str
    between: str
    kind: str
    source: str
    target: str
    heard: bool


@dataclasses.dataclass(frozen=True)
class Crossing:
    """A topic with nodes on several hosts; '' is the robot."""

    topic: str
    kind: str
    sources: tuple[str, ...]
    targets: tuple[str, ...]

    @property
    def large(self) -> bool:
        """Whether the topic is too large to measure its rate."""
        return self.kind in _LARGE


class Hosts:
    """
    The hosts of nodes.

    :param machines: node names by machine name.
    """

    def __init__(self, machines: Mapping[str, Iterable[str]]) -> None:
        self._of_node = {node: name for name, nodes in machines.items() for node in nodes}
        self._named = {identifier(name): name for name in machines}

    def machine(self, identified: Optional[str]) -> str:
        """Return the machine whose identifier is part of a node's name."""
        return self._named.get(identified, identified) if identified else ''

    def of(self, node: str) -> str:
        """Return the host of a node; unknown nodes are on the robot."""
        for pattern in (_ENCODER, _DECODER):
            if match := pattern.fullmatch(node):
                return self.machine(match['host'])
        return self._of_node.get(node, '')


def streams(topics: Iterable[Topic], nodes: Iterable[str], hosts: Hosts) -> list[Stream]:
    """Return the streams whose encoder is in the graph, one for each decoder."""
    by_name = {topic.name: topic for topic in topics}
    nodes = sorted(set(nodes))
    decoders = [match for node in nodes if (match := _DECODER.fullmatch(node))]
    results = []
    for node in nodes:
        encoder = _ENCODER.fullmatch(node)
        if encoder is None:
            continue
        for topic in by_name.values():
            name, _, last = topic.name.rpartition('/')
            if encoder['host']:
                name = name.removeprefix(f"/fogros2/{encoder['host']}")
            # in the names of plugins' streams
            name = name.removesuffix('/fogros2')
            if node not in topic.publishers or last != encoder['transport'] \
                    or identifier(name) != encoder['topic']:
                continue
            targets = [decoder['host'] for decoder in decoders if (
                decoder['topic'], decoder['transport'], decoder['source']) == (
                encoder['topic'], encoder['transport'], encoder['host'])]
            results += [Stream(
                name, last, topic.name, topic.kind, hosts.machine(encoder['host']),
                hosts.machine(target), bool(topic.subscribers - {OWN}))
                for target in targets]
    return sorted(results, key=lambda one: (one.source, one.topic, one.target))


def crossing(
    topics: Iterable[Topic], hosts: Hosts, streamed: Iterable[Stream],
) -> list[Crossing]:
    """Return the topics, except streams, with a publisher and a subscriber on different hosts."""
    streamed = list(streamed)
    between = {one.between for one in streamed}
    # The local replacements of a streamed topic stay on their machine.
    local = tuple(f'/fogros2/{identifier(host)}/' for one in streamed
                  for host in (one.source, one.target) if host)
    results = []
    for topic in topics:
        if topic.name.startswith(local) or _HIDDEN.fullmatch(topic.name) or topic.name in between \
                or topic.name.rpartition('/')[0] in between \
                and topic.name.rpartition('/')[2] in _OF_STREAM:
            continue
        sources = {hosts.of(node) for node in topic.publishers - {OWN}}
        targets = {hosts.of(node) for node in topic.subscribers - {OWN}}
        if any(source != target for source in sources for target in targets):
            results.append(Crossing(
                topic.name, topic.kind, tuple(sorted(sources)), tuple(sorted(targets))))
    return sorted(results, key=lambda one: one.topic)


def decoded(topic: Topic) -> bool:
    """Return whether all publishers of a topic are decoders of streams."""
    return bool(topic.publishers) and all(map(_DECODER.fullmatch, topic.publishers))
