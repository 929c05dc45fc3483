# SPDX-License-Identifier: Apache-2.0
"""
Decide which command a robot executes: blend overlapping chunks, stop without one.

All times are nanoseconds of the robot's clock. A chunk counts from the stamp of the observation
that it answers, and that stamp has to be one that the robot made.
"""

from __future__ import annotations

import dataclasses
from typing import Optional

import numpy

from fogros2_examples.meshes import Floats

#: Chunks and stamps that are kept at most.
CHUNKS, STAMPS = 64, 8192
SECOND = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class Chunk:
    """
    Actions from an observation on.

    :param stamp: of the observation.
    :param times: nanoseconds after the stamp, (n,), increasing.
    :param values: an action for each time, (n, joints).
    """

    stamp: int
    times: Floats
    values: Floats

    @property
    def horizon(self) -> int:
        """The time of the last action, after which the chunk has none."""
        return self.stamp + int(self.times[-1])

    def at(self, now: int) -> Floats:
        """Return the action of a time until the horizon, interpolated."""
        return numpy.array([numpy.interp(now - self.stamp, self.times, column)
                            for column in self.values.T])


@dataclasses.dataclass(frozen=True)
class Command:
    """
    What the robot does in a tick.

    :param values: (joints,).
    :param stamp: mean stamp of the observations behind it, weighted as the chunks are; None: no
        chunk has an action, and the robot stops.
    """

    values: Floats
    stamp: Optional[int]


class Queue:
    """
    Chunks that have an action now.

    :param blend: nanoseconds in which a new chunk takes over from the one before.
    :param longest: most nanoseconds from an observation to an action.
    :param velocity: whether actions are velocities: the robot stops by zeros, else by staying
        where it is.
    """

    def __init__(self, blend: int, longest: int, velocity: bool = False) -> None:
        self.blend, self.longest, self.velocity = blend, longest, velocity
        self._chunks: list[tuple[Chunk, int]] = []
        self._newest = -1
        self._stamps: dict[int, None] = {}
        self._last: Optional[Floats] = None
        self._held: Optional[Floats] = None

    def observe(self, stamp: int) -> None:
        """Remember that the robot has made an observation with this stamp."""
        self._stamps[stamp] = None
        if len(self._stamps) > STAMPS:
            del self._stamps[next(iter(self._stamps))]

    def add(self, chunk: Chunk, now: int) -> None:
        """
        Take a chunk that arrives.

        :raises ValueError: it is refused; the text has the reason.
        """
        # a clock that was set back has left the newest one in the future
        problems = {
            'its stamp is of no observation that this robot made': chunk.stamp not in self._stamps,
            'a newer one is there': chunk.stamp <= self._newest <= now,
            f'it lasts for more than {self.longest / SECOND:g} s': chunk.times[-1] > self.longest,
            'it is of the future': chunk.stamp > now,
            'all its actions are over': chunk.horizon < now}
        for problem, present in problems.items():
            if present:
                raise ValueError(problem)
        self._newest = chunk.stamp
        self._chunks = [*self._chunks[1 - CHUNKS:], (chunk, now)]

    def command(self, now: int, measured: Optional[Floats]) -> Optional[Command]:
        """
        Return the command of a tick; None before the first chunk.

        Each chunk takes over linearly, within ``blend`` or what the one before has left of its
        horizon.

        :param measured: angles of the joints; the robot stops there.
        """
        live = [(chunk, came) for chunk, came in self._chunks
                if chunk.stamp <= now <= chunk.horizon]
        values: Optional[Floats] = None
        stamp, first = 0.0, 0
        for number, (chunk, came) in enumerate(live):
            fade = max(1, min(self.blend, live[number - 1][0].horizon - came))
            if values is None or now - came >= fade:
                values, stamp, first = chunk.at(now), float(chunk.stamp), number
            else:
                share = max(0.0, (now - came) / fade)
                values = values + share * (chunk.at(now) - values)
                stamp += share * (chunk.stamp - stamp)
        self._chunks = live[first:]
        if values is not None:
            self._last, self._held = values, None
            return Command(values, round(stamp))
        if self._last is None:
            return None
        if self._held is None:
            self._held = self._last if measured is None else measured
        return Command(0 * self._held if self.velocity else self._held, None)
