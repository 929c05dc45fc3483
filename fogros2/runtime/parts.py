# SPDX-License-Identifier: Apache-2.0
"""What all features do in a launch: their :class:`fogros2.feature.LaunchPart` objects together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Optional

from fogros2 import feature
from fogros2.feature import LaunchPart, Program, RunningLaunch
from fogros2.model import NodeSpec

#: Items of nodes or groups, or what the parts resolved them to, by keyword.
Lists = Mapping[str, Any]


class Parts:
    """
    The parts of all features in a launch.

    Iteration yields them. Methods have the names and the contracts of ``LaunchPart``.
    """

    def __init__(self, launch: RunningLaunch) -> None:
        self._parts: dict[str, LaunchPart] = {
            one.node_list[0] or name: one.in_launch(launch)
            for name, one in feature.installed().items()}

    def __iter__(self) -> Iterator[LaunchPart]:
        return iter(self._parts.values())

    def check(self, lists: Lists) -> None:
        """Check items."""
        for keyword, items in lists.items():
            self._parts[keyword].check(items)

    def everywhere(self, lists: Lists, namespace: str) -> None:
        """Take items for every machine."""
        for keyword, items in lists.items():
            self._parts[keyword].everywhere(items, namespace)

    def resolve(self, lists: Lists, namespace: str) -> Lists:
        """Resolve items."""
        return {keyword: self._parts[keyword].resolve(items, namespace)
                for keyword, items in lists.items()}

    def beside(self, own: Lists, machine: Optional[str]) -> list[Program]:
        """Return the programs that a process needs."""
        return [program for keyword, part in self._parts.items()
                for program in part.beside(own.get(keyword, ()), machine)]

    def starting(self, machine: str, nodes: Sequence[NodeSpec]) -> Sequence[NodeSpec]:
        """Return nodes as they start."""
        for part in self:
            nodes = part.starting(machine, nodes)
        return nodes

    def names(self, machine: str) -> dict[str, str]:
        """Return new names of topics for components."""
        return {old: new for part in self for old, new in part.names(machine).items()}

    def topics(self, own: Lists) -> dict[str, tuple[str, bool]]:
        """Return topics with other names on machines: keyword, and whether the robot has it."""
        return {topic: (keyword, here) for keyword, part in self._parts.items()
                for topic, here in part.topics(own.get(keyword, ())).items()}
