# SPDX-License-Identifier: Apache-2.0
"""Collect the streams of a launch, and their nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import dataclasses
from typing import Any, Optional, TYPE_CHECKING

from fogros2.describe import keywords, kinds, values
from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec
from fogros2.ros_names import absolute, local_topic
from fogros2_features.streams import entries as streams
from fogros2_features.streams import topics
from fogros2_features.streams.entries import Entry, StreamTopic
from fogros2_features.streams.transport import Stream

if TYPE_CHECKING:
    from launch import LaunchContext


def check(entries: Iterable[Entry]) -> None:
    """
    Check entries, as far as they are plain texts already.

    :raises ConfigurationError: see :func:`fogros2_features.streams.entries.stream`.
    """
    for entry in map(streams.topic_of, entries):
        if all(isinstance(part, str) for part in (entry.topic, entry.transport, entry.direction)):
            # no machine has the name '', so it cannot be the source
            streams.stream(entry.but(topic=entry.topic and absolute(entry.topic, '/')), '')


def resolve(
    context: LaunchContext, entries: Iterable[Entry], namespace: str,
    source: Callable[[Any], Optional[str]],
) -> list[StreamTopic]:
    """
    Resolve the substitutions of entries, and expand their topics to full names.

    :param namespace: namespace of relative names.
    :param source: returns the name of the machine that a source means, None for the robot.
    """
    resolved: list[StreamTopic] = []
    for entry in map(streams.topic_of, entries):
        topic = values.resolve(context, entry.topic)
        resolved.append(entry.but(
            topic=topic and absolute(topic, namespace),
            transport=values.resolve(context, entry.transport),
            direction=values.resolve(context, entry.direction), source=source(entry.source),
            parameters={key: _parameter(context, value)
                        for key, value in entry.parameters.items()}))
    return resolved


class Streams:
    """The streams of a launch, and the nodes of them that were returned already."""

    def __init__(self) -> None:
        #: Bits per second of the links of machines, 0 for no limit.
        self.bandwidths: dict[str, float] = {}
        self._streams: list[Stream] = []
        self._handed_out: set[str] = set()

    def add(self, entries: Iterable[Entry], machine: str) -> list[tuple[Optional[str], NodeSpec]]:
        """
        Add streams to and from ``machine``.

        :return: the nodes that these streams need and no earlier stream did, each with the machine
            that it runs on, None for the robot.
        :raises ConfigurationError: see :mod:`fogros2_features.streams.entries`; or images would
            return to their source, or reach a host in two ways. Nothing is added then.
        """
        several = list(self._streams)
        for entry in entries:
            one = self._linked(streams.stream(entry, machine))
            if one not in several:
                for other in several:
                    _compare(one, other)
                several.append(one)
        streams.nodes(several)  # raises if a transport refuses them
        self._streams = several
        return self._not_handed_out()

    def take_over(
        self, machine: str,
    ) -> tuple[list[str], list[tuple[Optional[str], NodeSpec]], list[str]]:
        """
        Replace a machine by the robot in all streams, because its nodes move there.

        Streams between the two end. Streams between the machine and another machine become streams
        between the robot and that machine.

        :return: ids of nodes on other hosts that are no longer needed; new nodes, as from ``add``;
            topics that cannot move, because the robot already streams them in another way.
        """
        before = self._nodes_elsewhere(machine)
        several = [one for one in self._streams if machine not in (one.source, one.target)]
        unreachable: list[str] = []
        for one in self._streams:
            ends = {host for host in (one.source, one.target) if host != machine}
            if len(ends) == 2 or ends == {None}:
                continue  # another machine's stream, or one that ends
            # keep the camera info's route: other nodes already use its name
            moved = self._linked(dataclasses.replace(
                one, source=None if one.source == machine else one.source,
                target=None if one.target == machine else one.target,
                options={**one.options, 'camera_info': topics.carries_info(one)}))
            try:
                for other in several:
                    _compare(moved, other)
                streams.nodes([*several, moved])
            except ConfigurationError:
                unreachable.append(one.topic)
            else:
                several.append(moved)
        self._streams = several
        ended = sorted(before - self._nodes_elsewhere(machine))
        self._handed_out -= set(ended)
        return ended, self._not_handed_out(), unreachable

    def _linked(self, one: Stream) -> Stream:
        """Return the stream with the limited links that it crosses."""
        return dataclasses.replace(one, links={
            local_topic(f'/link_{way}', machine): bits
            for machine, way in ((one.source, 'out'), (one.target, 'in'))
            if machine is not None and (bits := self.bandwidths.get(machine))})

    def _not_handed_out(self) -> list[tuple[Optional[str], NodeSpec]]:
        """Return nodes that are needed and were not returned before; remember them as returned."""
        new = [(machine, spec) for machine, specs in streams.nodes(self._streams).items()
               for spec in specs if spec.id not in self._handed_out]
        self._handed_out |= {spec.id for _, spec in new}
        return new

    def _nodes_elsewhere(self, machine: str) -> set[str]:
        return {spec.id for host, specs in streams.nodes(self._streams).items()
                if host != machine for spec in specs}

    def remappings(self, machine: str) -> dict[str, str]:
        """Return the new names of streamed topics for nodes on a machine."""
        return streams.remappings(self._streams, machine)


def _compare(one: Stream, other: Stream) -> None:
    if one.topic != other.topic:
        return
    for host, end in ((one.source, other.target), (one.target, other.source)):
        if host == end:
            raise ConfigurationError(
                f'{one.topic} is streamed both from {_host(host)} and to it',
                'images that arrive would be sent back: rename one of the two topics')
    if (one.source, one.target) == (other.source, other.target) and (
            one.transport != other.transport or one.options != other.options):
        raise ConfigurationError(
            f'{one.topic} is streamed to {_host(one.target)} twice, in different ways',
            'use one transport with one set of parameters')


def _host(machine: Optional[str]) -> str:
    return 'the robot' if machine is None else f"'{machine}'"


def from_robot(entry: StreamTopic, away: Iterable[str]) -> StreamTopic:
    """Return a stream with the robot as its source, if its source is a preempted machine."""
    if entry.source not in away:
        return entry
    # the same form as a stream that ``take_over`` has moved
    return entry.but(source=None, parameters={'camera_info': False, **entry.parameters})


def _parameter(context: LaunchContext, value: Any) -> Any:
    if isinstance(value, (bool, int, float, str)):
        return value
    text = values.resolve(context, value)
    if not isinstance(text, str):
        return text
    # a substitution turns every value into a text: find its type as for one that is written out
    return keywords.read(kinds.Keyword('a parameter', 'scalar'), text)
