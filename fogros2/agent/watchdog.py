# SPDX-License-Identifier: Apache-2.0
"""When the machine has to end: the lifetime, the boot time-out, and missing heartbeats."""

from __future__ import annotations

from collections.abc import Callable
import math
import selectors
import socket
import time

from fogros2.agent.loop import Loop
from fogros2.agent.protocol import ANSWER, BEAT, DATAGRAM, Refused, sign, verify

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Optional

    from fogros2.agent.protocol import Json

#: Linux: allow to bind to an address that does not exist yet.
IP_FREEBIND = 15


class Watchdog:
    """
    Decide when a machine has to release its nodes; the caller passes the time in seconds.

    ``boot_timeout`` applies until a heartbeat is configured, then ``robot_timeout``.
    """

    def __init__(self, config: Json, now: float) -> None:
        self.config = config
        self.lifetime_from = now
        self.boot_from: Optional[float] = now
        self.beat_at: Optional[float] = None
        #: The number of the last heartbeat.
        self.number = 0
        #: Seconds since boot for which this computer was suspended, at the last check.
        self.suspended = math.inf

    @property
    def state(self) -> list[Any]:
        """What a restarted agent continues with, see ``resume``."""
        return [self.number, self.lifetime_from, self.boot_from, self.beat_at]

    def resume(self, state: Any, now: float) -> None:
        """
        Continue the deadlines of an agent that died.

        :raises TypeError, ValueError, OverflowError: ``state`` is damaged.
        """
        number, lifetime, boot, beat = state
        # a time after now is of a clock before a reboot
        self.lifetime_from = min(now, lifetime)
        self.boot_from = None if boot is None else min(now, boot)
        self.beat_at = None if beat is None else min(now, beat)
        self.number = int(number)

    def configured(self, now: float, *, heartbeat: bool) -> None:
        """Restart the lifetime and the heartbeat's deadline: a launch has configured the agent."""
        self.lifetime_from = now
        if heartbeat:
            self.boot_from, self.beat_at = None, now
        elif self.boot_from is not None:
            self.boot_from = now

    def beat(self, number: int, now: float) -> None:
        """Note a heartbeat; its time is ignored after ``disarm``."""
        self.number = number
        if self.beat_at is not None:
            self.beat_at = now

    def check_suspend(self, suspended: float, now: float) -> None:
        """Wait anew for the launch after a suspend, in which no heartbeat could arrive."""
        if suspended - self.suspended > 1.0:
            self.boot_from = None if self.boot_from is None else now
            self.beat_at = None if self.beat_at is None else now
        self.suspended = suspended

    def disarm(self) -> None:
        """Expect no heartbeat: the launch has ended or is known to be gone; keep the lifetime."""
        self.boot_from = self.beat_at = None

    @property
    def heard_at(self) -> Optional[float]:
        """When the current launch was last heard, None without a launch."""
        return self.boot_from if self.beat_at is None else self.beat_at

    def deadlines(self) -> list[tuple[float, str]]:
        """Return (time, reason as in the event) of each deadline, soonest first."""
        deadlines = [(self.lifetime_from + self.config['lifetime'], 'lifetime')]
        if self.boot_from is not None:
            deadlines.append((self.boot_from + self.config['boot_timeout'], 'no launch came'))
        if self.beat_at is not None:
            deadlines.append((self.beat_at + self.config['robot_timeout'], 'robot gone'))
        return sorted(deadlines)

    def due(self, now: float) -> Optional[str]:
        """Return the reason of a deadline that has passed, or None."""
        at, reason = self.deadlines()[0]
        return reason if now >= at else None


class Heartbeats:
    """
    Receive heartbeats for a watchdog, and answer them.

    :param save: stores the watchdog's state on disk.
    """

    def __init__(
        self, loop: Loop, config: Json, watchdog: Watchdog, save: Callable[[], None],
    ) -> None:
        self.loop = loop
        self.config = config
        self.watchdog = watchdog
        self.save = save
        self.socket: Optional[socket.socket] = None

    def open(self) -> None:
        """
        Listen for heartbeats at the configured address, if there is one.

        :raises Refused: the address cannot be used.
        """
        if self.socket is not None:
            self.loop.select(self.socket, 0, self._receive)
            self.socket.close()
            self.socket = None
        where = self.config['heartbeat']
        if not where:
            return
        link = None
        try:
            link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
            # the VPN's address may appear later, and disappear for a time
            link.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)
            link.bind((where['bind'], where['port']))
        except (OSError, OverflowError) as error:
            if link is not None:
                link.close()
            raise Refused(f"no heartbeats at {where['bind']}:{where['port']}: {error}") from error
        self.socket = link
        self.loop.select(link, selectors.EVENT_READ, self._receive)

    def _receive(self, mask: int) -> None:
        if self.socket is None:
            return  # closed by a release that was ready at the same time
        try:
            datagram, peer = self.socket.recvfrom(DATAGRAM)
            where = self.config['heartbeat']
            beat = verify(where['key'], BEAT, datagram) if peer[0] == where['peer'] else None
            if beat is None or beat[0] <= self.watchdog.number:
                return
            self.watchdog.beat(beat[0], self.loop.clock())
            self.save()
            self.socket.sendto(sign(where['key'], ANSWER.pack(*beat, time.time())), peer)
        except OSError:
            return  # the VPN is down
