# SPDX-License-Identifier: Apache-2.0
"""
Decide which messages of replicated nodes are forwarded; pure.

Replicas that work on the same input give their outputs the input's stamp. So the n-th message with
a stamp and a frame id is the same from each replica, and the first one is forwarded. One replica
may be the last: it gets an input only if no other has made an output of it by a deadline.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
import math
from typing import Optional

from fogros2_replicas.figures import Figures
from image_transport_h264.cdr import CdrError, Reader

#: Stamp in nanoseconds, and frame id.
Header = tuple[int, str]
#: Inputs that are remembered, and outputs without a match after which none is expected.
REMEMBERED, MISSES = 512, 10
#: Without matching stamps: messages of another replica, with none of the chosen one between them,
#: that make this other one the chosen one.
STREAK = 3
#: An input that is so many nanoseconds older than the newest one means that time was set back; an
#: output that is so much newer than the newest input is dropped.
SET_BACK = 1_000_000_000
#: Most inputs that are held for the last replica.
HELD = 32
#: Bytes of a frame id that are compared; maximum number of different ids of one stamp.
FRAME, FRAMES = 256, 1000


def header_of(data: bytes) -> Optional[Header]:
    """
    Read stamp and frame id of a serialized message that begins with ``std_msgs/Header``.

    :returns: None if the message is malformed.
    """
    try:
        seconds, nanoseconds, frame = Reader(data).header()
    except CdrError:
        return None
    return seconds * 1_000_000_000 + nanoseconds, frame[:FRAME]


class Pair:
    """
    An input topic and an output topic; all times are seconds of one clock.

    :param replicas: their names, in the order of preference.
    :param last: name of the last replica, '' for none.
    :param deadline: seconds after which it gets an input.
    """

    def __init__(
        self, replicas: Sequence[str], last: str = '', deadline: float = math.inf,
    ) -> None:
        self.replicas = {name: Figures(name) for name in replicas}
        self._last = last
        self._deadline = deadline
        #: Inputs that the last replica may get: when, their stamps, and themselves.
        self._held: deque[tuple[float, int, bytes]] = deque()
        #: Whether the others have missed a deadline, and made no output in time since.
        self._late = False
        #: Whether stamps of outputs match inputs; until then one replica is forwarded.
        self.matches = False
        #: Whether too many outputs match no input, which is worth a warning.
        self.unmatched = False
        self._inputs: dict[int, float] = {}
        self._latest = self._newest = -1
        self._misses = 0
        self._came: Counter[tuple[str, str]] = Counter()
        self._forwarded: Counter[str] = Counter()
        self._chosen: Optional[str] = None
        self._streaks: Counter[str] = Counter()

    def input(self, now: float, header: Optional[Header], data: bytes = b'') -> list[bytes]:
        """Record an input; return what the last replica gets now."""
        self._record(now, header)
        if not self._last:
            return []
        others = any(replica.there and not replica.died for replica in self.replicas.values()
                     if replica.name != self._last)
        if self._late or not others:
            return [data]
        if len(self._held) < HELD:  # the first ones, so that one becomes due
            stamp = header[0] if header is not None else 0
            self._held.append((now + self._deadline, stamp, data))
        return []

    def next_due(self) -> float:
        """Return when to call :meth:`due` next; infinity for never."""
        return self._held[0][0] if self._held else math.inf

    def due(self, now: float) -> list[bytes]:
        """Return the inputs of which no replica has made an output in time, for the last one."""
        due = []
        while now >= self.next_due():
            due.append(self._held.popleft()[2])
            self._late = True
        return due

    def _in_time(self, now: float, header: Optional[Header], begin: Optional[float]) -> None:
        """Forget the inputs up to that of an output; without a match, all."""
        if begin is None or now - begin <= self._deadline:
            self._late = False
        while self._held and (begin is None or header is None or self._held[0][1] <= header[0]):
            self._held.popleft()

    def _record(self, now: float, header: Optional[Header]) -> None:
        stamp = header[0] if header is not None else 0
        if not stamp:
            return  # 0 is no stamp
        if stamp < self._latest - SET_BACK:
            self._inputs.clear()
            self._newest = -1
        self._latest = stamp
        self._inputs.setdefault(stamp, now)
        while len(self._inputs) > REMEMBERED:
            del self._inputs[next(iter(self._inputs))]

    def output(self, now: float, name: str, header: Optional[Header]) -> bool:
        """Return whether to forward an output of a replica."""
        replica = self.replicas[name]
        replica.died = False
        begin = None if header is None else self._inputs.get(header[0])
        if name != self._last:
            self._in_time(now, header, begin)
        if begin is not None:
            replica.took(now - begin)
            self.matches, self.unmatched = True, False
        elif not self.matches:
            self._misses += 1
            self.unmatched = self._misses >= MISSES
        elif header is not None and header[0] > self._latest + SET_BACK:
            return False  # it answers no input, and would make all others old
        first = self._is_first(name, header) if self.matches and header is not None \
            else self._is_chosen(name)
        replica.won += first
        return first

    def started(self, name: str) -> None:
        """Record that a replica's process has started again."""
        self.replicas[name].died = False

    def died(self, name: str) -> None:
        """Choose no replica whose process has ended."""
        self.replicas[name].died = True
        self.replicas[name].failures += 1
        if self._chosen == name:
            self._chosen = None

    def _is_first(self, name: str, header: Header) -> bool:
        stamp, frame = header
        if stamp < self._newest:
            return False
        if stamp > self._newest:
            self._newest = stamp
            self._came.clear()
            self._forwarded.clear()
        if len(self._came) == FRAMES and (name, frame) not in self._came:
            return False
        self._came[name, frame] += 1
        if self._came[name, frame] <= self._forwarded[frame]:
            return False
        self._forwarded[frame] += 1
        return True

    def _is_chosen(self, name: str) -> bool:
        self._streaks[name] += 1
        if self._chosen is None or self._streaks[name] >= STREAK:
            self._chosen = name
        if name == self._chosen:
            self._streaks.clear()
            return True
        return False
