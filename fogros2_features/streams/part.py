# SPDX-License-Identifier: Apache-2.0
"""What streams do in a launch: their nodes, the names of their topics, and warnings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Optional

import launch.logging

from fogros2 import feature
from fogros2.errors import ConfigurationError
from fogros2.feature import LaunchPart, Program, RunningLaunch
from fogros2.model import NodeSpec
from fogros2.ros_names import remapped
from fogros2.runtime.node_spec import full_name
from fogros2_features.streams import collection, uncompressed
from fogros2_features.streams.entries import Entry, StreamTopic
from fogros2_features.streams.policy import Policy


class Part(LaunchPart):
    """The streams of a launch."""

    def __init__(self, launched: RunningLaunch) -> None:
        self._launch = launched
        self._streams = collection.Streams()
        #: By machine: the entries that were added.
        self._added: dict[str, list[StreamTopic]] = {}
        self._everywhere: list[tuple[Sequence[Entry], str]] = []
        #: By machine: the topic names that the first loaded components got.
        self._component_names: dict[str, dict[str, str]] = {}
        #: Machines whose links have the programs of limits.
        self._limited: set[str] = set()
        self._logger = launch.logging.get_logger('fogros2')

    def check(self, items: Sequence[Entry]) -> None:
        """Check entries."""
        collection.check(items)

    def everywhere(self, items: Sequence[Entry], namespace: str) -> None:
        """Stream topics between the robot and every machine, resolved when a process executes."""
        collection.check(items)
        self._everywhere.append((items, namespace))

    def resolve(self, items: Sequence[Entry], namespace: str) -> list[StreamTopic]:
        """Resolve entries."""
        resolved = self._resolved(items, namespace)
        collection.check(resolved)
        return resolved

    def _resolved(self, items: Sequence[Entry], namespace: str) -> list[StreamTopic]:
        return collection.resolve(
            self._launch.context, items, namespace, self._launch.name_of)

    def beside(self, own: Sequence[StreamTopic], machine: Optional[str]) -> list[Program]:
        """Return the nodes that a process needs for streams and limits, and no earlier one did."""
        if machine is not None:
            return [*self._add(own, machine), *self._limit(machine)]
        # the robot has its own topics; other machines send theirs
        return [program for entry in own if entry.source is not None for program in self._add(
            [entry.but(direction='to_robot', source=None)], entry.source)]

    def _policy(self, machine: str) -> Policy:
        made: Policy = feature.options(
            'streams', self._launch.spec(machine).features.get('streams', {}))
        return made

    def _limit(self, machine: str) -> list[Program]:
        policy = self._policy(machine)
        _refuse(self._launch.machines[machine].renamed, policy.names(machine),
                f"deny_topics or limit_topics of '{machine}'",
                'the first answer of replicas already carries it')
        if machine in self._limited:
            return []
        self._limited.add(machine)
        return [Program(spec, host, machine) for host, spec in policy.ends(machine)]

    def _all(self, own: Iterable[StreamTopic]) -> list[StreamTopic]:
        return [*(entry for some in self._everywhere for entry in self._resolved(*some)), *own]

    def _add(self, own: Iterable[StreamTopic], machine: str) -> list[Program]:
        added = self._added.setdefault(machine, [])
        streams = [entry for entry in self._all(own) if entry not in added]
        if not streams:
            return []
        machines = self._launch.machines
        away = [name for name, one in machines.items() if one.interrupted]
        before = {name: self._streams.remappings(name) for name in machines}
        ends = {machine, *(entry.source for entry in streams if entry.source is not None)}
        for name in ends:
            self._streams.bandwidths[name] = self._policy(name).bandwidth
        moved = [collection.from_robot(entry, away) for entry in streams]
        for entry in moved:
            self._refuse_apart(entry, machine)
        new = self._streams.add(moved, machine)
        for name in ends:
            names = self._streams.remappings(name)
            _refuse(names, self._policy(name).limits,
                    f"limit_topics of '{name}'", 'a stream already carries it')
            _refuse(names, self._launch.spec(name).features.get('share', {}).get('share', ()),
                    f"share= of '{name}'", 'a stream gives it another name there')
        added += streams
        # another machine may be the source
        for name in machines:
            self._warn_of_early(name, before[name])
        return [Program(spec, host, machine) for host, spec in new]

    def _refuse_apart(self, entry: StreamTopic, machine: str) -> None:
        """Refuse a stream between machines that no VPN connects."""
        if entry.source is None:
            return
        ends = [self._launch.other_vpn(name) for name in (entry.source, machine)]
        if len({other and other.interface.network for other in ends}) > 1:
            raise ConfigurationError(
                f"{entry.topic} can't be streamed from '{entry.source}' to '{machine}': machines "
                'of different robots do not reach each other',
                'stream it to the robot, and from there by another name')

    def _warn_of_early(self, machine: str, before: Mapping[str, str]) -> None:
        names = self._streams.remappings(machine)
        new = [name for name in names if name not in before]
        early = [node.name for node in self._launch.machines[machine].sent
                 if '--ros-args' in node.arguments] if new else []
        if early:
            self._logger.warning(
                f"{machine}: {', '.join(early)} started before {', '.join(new)} became a "
                'stream and get it unencoded; use a FogROSLaunchDescription, or add the stream to '
                'the first node of the machine')
        loaded = self._component_names.get(machine, names)
        late = [name for name in names if name not in loaded]
        if late:
            self._logger.warning(
                f"{machine}: components were loaded before {', '.join(late)} became a "
                'stream and get it unencoded; add the stream to the container')
            del self._component_names[machine]

    def starting(self, machine: str, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """Rename the topics of nodes that have other names on the machine."""
        names = {**self._policy(machine).names(machine), **self._streams.remappings(machine)}
        without_arguments = [node.name for node in nodes if '--ros-args' not in node.arguments
                             and node.package != 'fogros2']
        if names and without_arguments:
            self._logger.warning(
                f"{machine}: {', '.join(without_arguments)} takes no ROS arguments and so "
                f"does not use the new name or the stream of {', '.join(names)}; if it is a ROS "
                "node that uses the topic, add '--ros-args' to its command")
        return [remapped(node, names) for node in nodes]

    def names(self, machine: str) -> dict[str, str]:
        """Return the new names of topics."""
        names = self._streams.remappings(machine)
        loaded = self._component_names.setdefault(machine, names)
        self._component_names[machine] = {
            name: new for name, new in loaded.items() if name in names}
        return {**self._policy(machine).names(machine), **names}

    def topics(self, own: Sequence[StreamTopic]) -> dict[str, bool]:
        """Return the streamed topics, and whether the robot publishes each."""
        entries = self._all(own)
        here = {entry.topic for entry in entries
                if entry.direction == 'to_cloud' and entry.source is None}
        return {entry.topic: entry.topic in here for entry in entries}

    def moved(self, machine: str) -> tuple[list[str], list[Program]]:
        """Let the robot take the machine's place in streams; its link has no limits any more."""
        ended, new, lost = self._streams.take_over(machine)
        self._added.clear()
        ended += [node.id for host, node in self._policy(machine).ends(machine) if host is None]
        self._limited.discard(machine)
        if lost:
            self._logger.warning(f"{', '.join(lost)} of '{machine}' no longer reaches other "
                                 'machines: the robot streams it in another way')
        return ended, [Program(spec, host) for host, spec in new]

    def watch(self) -> None:
        """Warn of images that cross the VPN uncompressed."""
        uncompressed.watch(
            lambda: uncompressed.carried(self._launch.interface), self._crossing_images,
            self._logger.warning, self._launch.ended)

    def _crossing_images(self) -> list[str]:
        # copied, because this runs in a thread and the launch may add machines
        machines = {
            name: [full_name(node).rpartition('/')[2] for node in machine.sent]
            for name, machine in list(self._launch.machines.items())}
        return uncompressed.crossing_images(
            machines, self._launch.environment, self._launch.ended)


def _refuse(carried: Iterable[str], topics: Iterable[str], place: str, reason: str) -> None:
    """Refuse topics of a policy that cross in another way."""
    if both := sorted({*carried} & {*topics}):
        raise ConfigurationError(f"{', '.join(both)} can't be in {place}: {reason}",
                                 'leave one of the two out')
