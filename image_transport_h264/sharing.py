# SPDX-License-Identifier: Apache-2.0
"""
Divide the bandwidth of a link among its streams by weighted max-min fairness; pure.

Each stream of a link reports a claim several times a second. All streams compute the same
division from the same claims, so there is no arbiter that could fail. A stream takes more only
when the others have reported less, so a new stream takes nothing from a stream that still
sends.
"""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import re
from typing import Any, Optional

import numpy as np

#: The part of a bandwidth that is divided; the rest is for the headers of DDS, UDP and the VPN,
#: for acknowledgements and camera info.
PAYLOAD = 0.8
#: Seconds for which a claim is valid, and for which a new stream listens before it sends.
VALID, LISTEN = 1.5, 0.6
#: Maximum bits per second of a report, and of a stream that can use any bandwidth.
MOST, UNLIMITED = 1e12, 1e9
#: A stream that uses more than LIMITED of its share would perhaps use more without it. Otherwise
#: it needs ROOM times what it uses; the need stays while it is between STEADY times the use.
LIMITED, ROOM, STEADY = 0.6, 2.0, (1.4, 3.0)
#: Maximum number of streams of a link, and of links of a stream.
MOST_STREAMS, MOST_LINKS = 256, 16
#: Maximum characters of a stream's name; a topic's name has fewer.
_NAME = 255
#: Names of links. A machine chooses among them: an encoder publishes nowhere else, such as on the
#: topic of a controller that takes the same type.
_LINK = re.compile(r'/fogros2/[A-Za-z]\w{0,63}/link_(in|out)', re.ASCII)


@dataclasses.dataclass(frozen=True)
class Claim:
    """
    What a stream needs, in bits per second.

    :param priority: weight in the division.
    :param floor: minimum that is of use.
    :param need: what the stream would use now, with room for motion.
    :param ceiling: the most that it can ever use.
    :param share: what it uses at most at present.
    :param latency: seconds from the encoder to the decoder.
    """

    priority: float
    floor: float
    need: float
    ceiling: float
    share: float
    latency: float = 0.0


def divide(bandwidth: float, claims: Mapping[str, Claim]) -> dict[str, float]:
    """
    Divide a bandwidth among claims; return the shares, whose sum does not exceed it.

    All get their floor, then up to their need, then up to their ceiling. Where the bandwidth ends,
    those with the least for their priority come first (weighted max-min fairness).
    """
    priorities = np.array([one.priority for one in claims.values()])
    low = np.zeros(len(claims))
    for high in np.maximum.accumulate(np.array([
            [getattr(one, what) for one in claims.values()]
            for what in ('floor', 'need', 'ceiling')])):
        if high.sum() > bandwidth:
            break
        low = high
    else:
        return dict(zip(claims, low.tolist()))
    below, above = 0.0, float((high / priorities).max())
    for _ in range(60):
        level = (below + above) / 2
        if np.clip(level * priorities, low, high).sum() > bandwidth:
            above = level
        else:
            below = level
    return dict(zip(claims, np.clip(below * priorities, low, high).tolist()))


def needed(used: float, share: float, before: float, ceiling: float, *, short: bool) -> float:
    """
    Return what a stream needs.

    :param used: recently sent bits per second.
    :param share: its share, infinite without one.
    :param before: the last result.
    :param short: whether the stream gives up quality because of its share.
    """
    if short or used > LIMITED * share:
        return ceiling
    if STEADY[0] * used <= before <= STEADY[1] * used:
        return before  # small changes move no shares, because encoders pay for each move
    return min(ceiling, ROOM * used)


class Link:
    """One direction of a link, as one of its streams knows it; times are seconds of one clock."""

    def __init__(self, bandwidth: float, now: float) -> None:
        self.bandwidth, self._since = bandwidth, now
        #: Whether the stream crosses the link now.
        self.used = False
        self._claims: dict[str, tuple[float, Claim]] = {}

    def heard(self, message: Any, now: float) -> None:
        """Record a report of another stream."""
        report = claim_of(message)
        if report is None:
            return
        name, claim = report
        if name not in self._claims and len(self._claims) >= MOST_STREAMS:
            self._claims = {each: (when, other) for each, (when, other) in self._claims.items()
                            if now - when < VALID}
        if name in self._claims or len(self._claims) < MOST_STREAMS:
            self._claims[name] = now, claim

    def share(self, name: str, claim: Claim, now: float) -> float:
        """Return the share of the stream ``name``; without free room, at most its floor."""
        others = {each: other for each, (when, other) in self._claims.items()
                  if now - when < VALID and each != name}
        room = PAYLOAD * self.bandwidth
        fair = divide(room, {**others, name: claim})[name]
        free = room - sum(other.share for other in others.values())
        return min(fair, max(claim.floor, free if now - self._since >= LISTEN else 0.0))


def claim_of(message: Any) -> Optional[tuple[str, Claim]]:
    """Return the stream and the claim of a ``Float64MultiArray``, None if it is invalid."""
    if (len(message.layout.dim) != 1 or len(message.data) != 6
            or len(message.layout.dim[0].label) > _NAME
            or not all(0 <= value <= MOST for value in message.data)
            or not 0.01 <= message.data[0] <= 100.0):
        return None
    return message.layout.dim[0].label, Claim(*message.data)


def links_of(message: Any) -> dict[str, float]:
    """Return the links of a decoder's announcement with their bandwidths; skip invalid ones."""
    return {dim.label: bandwidth for dim, bandwidth in zip(message.layout.dim, message.data)
            if _LINK.fullmatch(dim.label) and 0 < bandwidth <= MOST}
