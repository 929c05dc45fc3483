# SPDX-License-Identifier: Apache-2.0
"""
Decide which replicas of a service get a request, and which answer is the answer; pure.

A request goes to all live replicas, or to the nearest one and after a delay to the next, as in
"The tail at scale" (Dean, Barroso 2013) and gRPC's hedging. A failure sends it on at once. One
replica may be the last: it is asked when no other is live, or has answered by a deadline.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import math
from typing import Any, Literal, Optional, Union

from fogros2_replicas.figures import Figures

#: Milliseconds until the next replica is asked, or 'p95': the learned percentile of the replica
#: that was asked; None: all replicas are asked at once.
HedgeAfter = Union[None, float, Literal['p95']]
#: A replica that leaves this many requests unanswered, which others have answered, is too slow.
BEHIND = 16
#: Requests to a service, and requests of one replica, that may be without an answer.
MOST = 256
#: Seconds between two requests to a replica that is left out (PROBE), or that is not needed
#: (REFRESH): its answers show its latency. After PROBE, a request without any answer goes to a
#: replica that is left out. PAUSE is the first pause of requests that no replica can answer.
PROBE, REFRESH, PAUSE = 2.0, 30.0, 2.0


@dataclasses.dataclass(frozen=True)
class Send:
    """Send a request to a replica."""

    call: int
    replica: str


@dataclasses.dataclass(frozen=True)
class Answer:
    """Answer a client."""

    call: int
    response: Any


@dataclasses.dataclass(frozen=True)
class Drop:
    """Forget a request: its client has no answer from any replica."""

    call: int


Action = Union[Send, Answer, Drop]


@dataclasses.dataclass
class _Call:
    """A request without an answer: who has it, who has failed, when to ask the next one."""

    asked: set[str] = dataclasses.field(default_factory=set)
    failed: set[str] = dataclasses.field(default_factory=set)
    error: Any = None
    due: float = math.inf
    #: When the last replica is asked.
    deadline: float = math.inf
    #: Pause after which it is sent again; 0 while some replica may still answer.
    pause: float = 0.0


class Calls:
    """
    The requests to one service; all times are seconds of one clock.

    :param replicas: their names.
    :param hedge_after: see :data:`HedgeAfter`.
    :param last: name of the last replica, '' for none.
    :param deadline: seconds after which it is asked.
    """

    def __init__(
        self, replicas: Sequence[str], hedge_after: HedgeAfter = None, last: str = '',
        deadline: float = math.inf,
    ) -> None:
        self.replicas = {name: Figures(name) for name in replicas}
        self._hedge_after = hedge_after
        self._last = self.replicas.get(last)
        self._deadline = deadline if last else math.inf
        self._calls: dict[int, _Call] = {}

    def ask(self, now: float, call: int) -> list[Action]:
        """Return whom to send a new request, and which one to drop; ``call`` is its number."""
        one = self._calls[call] = _Call(deadline=now + self._deadline)
        if len(self._calls) > MOST:  # clients that ask again have given up the oldest one
            oldest = next(iter(self._calls))
            del self._calls[oldest]
            return [Drop(oldest), *self._first(now, call, one)]
        return self._first(now, call, one)

    def _first(self, now: float, call: int, one: _Call) -> list[Action]:
        """Send a new request."""
        live = self._live() or self._at_last(one)
        if not live:
            return self._send_to_any(now, call, one)
        targets = live[:1] if self._delay(live[0]) is not None else live
        targets += [replica for replica in self.replicas.values()
                    if replica.there and replica not in (*targets, self._last)
                    and now - replica.last >= (REFRESH if replica.live else PROBE)]
        return self._send(now, call, targets)

    def answered(
        self, now: float, call: int, name: str, response: Any, *, failed: bool = False,
    ) -> list[Action]:
        """
        Return what follows from a replica's answer; nothing if it comes too late.

        :param failed: the answer says that the service has failed; it counts if all have failed.
        """
        replica = self.replicas[name]
        begin = replica.sent.pop(call, None)
        if begin is None:
            return []
        replica.took(now - begin)
        replica.late = replica.late and now - begin > self._deadline
        replica.died = replica.died and begin < replica.died_at
        # A server answers in order, so requests before this one were lost.
        replica.sent = {other: at for other, at in replica.sent.items()
                        if other > call or other in self._calls}
        if replica.slow and self._behind(replica) <= BEHIND // 4:
            replica.slow = False
        one = self._calls.get(call)
        if one is None:
            return []
        if failed:
            replica.failures += 1
            one.error = response
            if replica is not self._last:
                return self._failed(now, call, name)
            return self._settle(call, response)  # the others have had their time
        replica.won += 1
        return self._settle(call, response)

    def died(self, now: float, name: str) -> list[Action]:
        """Leave out a replica whose process has ended; send its requests to the next one."""
        replica = self.replicas[name]
        replica.died, replica.died_at = True, now
        replica.failures += 1
        return self._lost(now, name)

    def started(self, name: str) -> None:
        """Take back a replica whose process has started again."""
        self.replicas[name].died = self.replicas[name].late = self.replicas[name].slow = False

    def ready(self, now: float, names: Iterable[str]) -> list[Action]:
        """Record which replicas the ROS graph shows; send what waits for one."""
        names = set(names)
        removals = [name for name, one in self.replicas.items() if one.there and name not in names]
        if any(not self.replicas[name].there for name in names):
            for call in self._calls.values():
                call.due = now if call.pause else call.due
        for name, replica in self.replicas.items():
            replica.there = name in names
        return [action for name in removals for action in self._lost(now, name)] + self.due(now)

    def next_due(self) -> float:
        """Return when to call :meth:`due` next; infinity for never."""
        return min((one.due for one in self._calls.values()), default=math.inf)

    def due(self, now: float) -> list[Action]:
        """Return which requests go to another replica, because none has answered in time."""
        actions: list[Action] = []
        for call, one in list(self._calls.items()):
            if one.due > now:
                continue
            one.due = math.inf
            if one.pause:
                actions += self._send_to_any(now, call, one)
                continue
            over = now >= one.deadline
            for name in one.asked - one.failed if over or self._hedge_after is not None else ():
                self.replicas[name].late = True
            last = self._at_last(one) if over else []
            if over:  # a last replica that is not there yet is looked for again
                asked = last or self._last is None or self._last.name in one.asked
                one.deadline = math.inf if asked else now + PROBE
            actions += self._send(now, call, last or self._next(one, self._live()))
            one.due = min(one.due, one.deadline)
        return actions

    # -- the rules ------------------------------------------------------------------------------

    def _live(self) -> list[Figures]:
        """Return the live replicas, the nearest first; unknown latencies come before all."""
        return sorted((replica for replica in self.replicas.values()
                       if replica.live and replica is not self._last),
                      key=lambda replica: replica.latency or 0.0)

    def _at_last(self, one: _Call) -> list[Figures]:
        """Return the last replica, unless there is none or it has the request."""
        last = self._last
        return [last] if last is not None and last.there and last.name not in one.asked else []

    def _delay(self, replica: Figures) -> Optional[float]:
        if self._hedge_after == 'p95':
            return replica.p95
        return None if self._hedge_after is None else self._hedge_after / 1000

    def _next(self, one: _Call, first: Sequence[Figures]) -> list[Figures]:
        """Return the next replica for a request: of the first ones, or one that is left out."""
        others = (replica for replica in self.replicas.values()
                  if replica.there and not (replica.live or replica.died)
                  and replica is not self._last)
        for replica in (*first, *others):
            if replica.name not in one.asked:
                return [replica]
        return []

    def _send(self, now: float, call: int, replicas: Iterable[Figures]) -> list[Action]:
        one = self._calls[call]
        actions: list[Action] = []
        for replica in replicas:
            replica.last = replica.sent[call] = now
            if len(replica.sent) > MOST:
                del replica.sent[next(iter(replica.sent))]
            one.asked.add(replica.name)
            one.failed.discard(replica.name)
            one.due = min(one.due, now + (self._delay(replica) or PROBE), one.deadline)
            actions.append(Send(call, replica.name))
        return actions

    def _send_to_any(self, now: float, call: int, one: _Call) -> list[Action]:
        """Send a request to all replicas if none is live; again later if all have died."""
        candidates = [replica for replica in self.replicas.values() if replica.there]
        alive = [replica for replica in candidates if not replica.died]
        actions = self._send(now, call, alive or candidates)
        if one.pause or not alive:
            self._hold(now, one)
        return actions

    def _hold(self, now: float, one: _Call) -> None:
        one.pause = 2 * one.pause or PAUSE
        one.due = now + one.pause

    def _lost(self, now: float, name: str) -> list[Action]:
        """Send the requests that a replica can no longer answer to the next one."""
        return [action for call, one in list(self._calls.items())
                if name in one.asked - one.failed for action in self._failed(now, call, name)]

    def _failed(self, now: float, call: int, name: str) -> list[Action]:
        one = self._calls[call]
        one.failed.add(name)
        # the last one while no other may still answer
        last = [] if one.asked - one.failed else self._at_last(one)
        actions = self._send(now, call, self._next(one, [*self._live(), *last]))
        if actions or one.asked - one.failed:
            return actions
        if one.error is not None:
            return self._settle(call, one.error)
        self._hold(now, one)
        return []

    def _settle(self, call: int, response: Any) -> list[Action]:
        one = self._calls.pop(call)
        for name in one.asked:
            replica = self.replicas[name]
            replica.slow = replica.slow or self._behind(replica) >= BEHIND
        return [Answer(call, response)]

    def _behind(self, replica: Figures) -> int:
        """Return how many requests it has not answered although another replica has."""
        return sum(call not in self._calls for call in replica.sent)
