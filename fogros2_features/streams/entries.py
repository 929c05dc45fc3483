# SPDX-License-Identifier: Apache-2.0
"""Convert a launch file's stream entries to streams and nodes; pure except plugins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
from typing import Any, Literal, Optional, Union

from fogros2 import plugin_system
from fogros2.describe import values
from fogros2.errors import ConfigurationError, did_you_mean
from fogros2.model import NodeSpec
from fogros2.ros_names import local_topic
from fogros2_features.streams.topics import camera_info_topic, carries_info, check, check_option
from fogros2_features.streams.transport import GROUP, ImageTransport, Stream

Direction = Literal['to_cloud', 'to_robot']


@dataclasses.dataclass(frozen=True, init=False)
class StreamTopic:
    """
    A topic that crosses the VPN encoded.

    ``stream_topics=`` of nodes with a machine, of CloudGroup and of Replicated takes a list of
    them. A pair ``(topic, transport)`` is one that the robot publishes and the machine reads.
    Those of a FogROSLaunchDescription are between the robot and every machine of the launch.

    ::

        CloudNode(machine=..., stream_topics=[
            ('/camera', 'h264'),
            StreamTopic('/annotated', 'h264', 'to_robot', bitrate=2_000_000),
            StreamTopic('/map', 'h264', source=mapper)])

    :param topic: the full name, which publisher and subscriber use.
    :param transport: 'h264', 'compressed', 'raw', or another installed transport.
    :param direction: 'to_cloud' (the robot or ``source`` publishes) or 'to_robot'.
    :param source: another machine of the launch, or its name, that publishes instead of the robot.
    :param parameters: options of the transport; see doc/h264.md.
    """

    topic: str
    transport: str
    direction: Direction
    parameters: Mapping[str, Any]
    source: Any

    def __init__(
        self, topic: str, transport: str = 'h264', direction: Direction = 'to_cloud', *,
        source: Any = None, **parameters: Any,
    ) -> None:
        for name, value in (('topic', topic), ('transport', transport), ('source', source),
                            ('direction', direction), ('parameters', parameters)):
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        return values.describe(self.topic)

    def but(self, **changes: Any) -> StreamTopic:
        """Return the topic with other values."""
        fields = {**vars(self), **changes}
        parameters = fields.pop('parameters')
        return StreamTopic(**fields, **parameters)


#: A stream in a launch file.
Entry = Union[StreamTopic, tuple[str, str]]


def topic_of(entry: Entry) -> StreamTopic:
    """
    Return an entry as a StreamTopic.

    :raises ConfigurationError: it is none, and no pair.
    """
    if isinstance(entry, tuple) and len(entry) == 2:
        return StreamTopic(*entry)
    if not isinstance(entry, StreamTopic):
        raise ConfigurationError(f'{entry!r} is no topic to stream',
                                 "write ('/camera', 'h264') or StreamTopic(...)")
    return entry


def stream(entry: Entry, machine: str) -> Stream:
    """
    Convert an entry to the stream to or from ``machine``.

    :param entry: with its source, if any, as a name.
    :raises ConfigurationError: no valid entry; an unknown transport (the hint lists all),
        direction or parameter, or its value; a topic that cannot be streamed.
    :raises PrerequisiteError: the robot lacks what its end of the stream needs.
    """
    entry = topic_of(entry)
    transports = plugin_system.names(GROUP)
    if entry.transport not in transports:
        raise ConfigurationError(
            f"{entry.topic}: there is no image transport '{entry.transport}'",
            did_you_mean(entry.transport, transports, all_too=True))
    if entry.direction not in ('to_cloud', 'to_robot'):
        raise ConfigurationError(f"{entry.topic}: direction '{entry.direction}' is unknown",
                                 "there are 'to_cloud' and 'to_robot'")
    to_cloud = entry.direction == 'to_cloud'
    if entry.source is not None and not to_cloud:
        raise ConfigurationError(f"{entry.topic}: a stream 'to_robot' has its source already",
                                 'leave source= out: the machine it stands at publishes')
    made = Stream(entry.topic, entry.transport, source=entry.source if to_cloud else machine,
                  target=machine if to_cloud else None, options=dict(entry.parameters))
    check(made)
    transport = _transport(made)
    for name, value in entry.parameters.items():
        if transport.options is not None and name not in transport.options:
            raise ConfigurationError(
                f"{entry.topic}: streams by {entry.transport} have no '{name}'",
                did_you_mean(name, sorted(transport.options)))
        check_option(entry.topic, name, value, transport)
    if None in (made.source, made.target):
        transport.check()
    return made


def nodes(streams: Iterable[Stream]) -> dict[Optional[str], list[NodeSpec]]:
    """
    Return the nodes of streams, by the machine that they run on (None: the robot).

    A node that several streams need, such as an encoder for two machines, is returned once.

    :raises ConfigurationError: two streams encode a topic in different ways.
    :raises PrerequisiteError: a dependency of a transport is not installed.
    """
    by_machine: dict[Optional[str], dict[str, NodeSpec]] = {}
    topics_of: dict[tuple[Optional[str], str], str] = {}
    informed: dict[tuple[Optional[str], Optional[str], str], str] = {}
    for one in streams:
        transport = _transport(one)
        decoded = one
        if transport.camera_info and carries_info(one):
            # images with the same parent share one camera info: send it with the first of them
            info = camera_info_topic(one.topic)
            if informed.setdefault((one.source, one.target, info), one.topic) != one.topic:
                decoded = dataclasses.replace(one, options={**one.options, 'camera_info': False})
        for machine, spec in ((one.source, transport.encoder(one)),
                              (one.target, transport.decoder(decoded))):
            own = by_machine.setdefault(machine, {})
            other = topics_of.setdefault((machine, spec.id), one.topic)
            if other != one.topic:
                raise ConfigurationError(
                    f"the streams {other} and {one.topic} can't have nodes of different names",
                    'remap one of the topics to another name')
            if own.setdefault(spec.id, spec) != spec:
                raise ConfigurationError(
                    f'{one.topic} is streamed twice with different parameters',
                    'give both streams the same ones')
    return {machine: list(specs.values()) for machine, specs in by_machine.items()}


def remappings(streams: Iterable[Stream], machine: Optional[str]) -> dict[str, str]:
    """
    Return the new names of streamed topics for nodes on a host; empty on the robot.

    They apply to nodes that subscribe to a topic or publish it.

    :param machine: the machine of the nodes, None for the robot.
    """
    names: dict[str, str] = {}
    for one in streams:
        if machine is not None and machine in (one.source, one.target):
            names[one.topic] = local_topic(one.topic, machine)
            if _transport(one).camera_info and carries_info(one):
                info = camera_info_topic(one.topic)
                names[info] = local_topic(info, machine)
    return names


def _transport(one: Stream) -> ImageTransport:
    made: ImageTransport = plugin_system.load(GROUP, one.transport)()
    return made
