# SPDX-License-Identifier: Apache-2.0
"""Heartbeats to a machine's agent through the VPN."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import Optional

from fogros2.agent.protocol import ANSWER, BEAT, DATAGRAM, sign, verify
from fogros2.clock import ClockOffset, OffsetFilter
from fogros2.untrusted import LARGEST

#: Interval of heartbeats in seconds.
HEARTBEAT_INTERVAL = 2.0
#: Shortest one, for a short ``robot_timeout``.
_SHORTEST = 0.25
#: Longest round trip in seconds that measures the machine's clock.
LONGEST = 20.0


def interval_for(robot_timeout: float) -> float:
    """Return the interval at which some heartbeats may be lost within ``robot_timeout``."""
    return max(_SHORTEST, min(HEARTBEAT_INTERVAL, robot_timeout / 4))


class Heartbeat:
    """
    Send heartbeats to a machine through the VPN; measure the round trip and its clock.

    Starts at once. Lost datagrams, or a VPN that is down for a while, raise no errors.

    :param address: the machine's VPN address.
    :param port: the agent's port on the machine.
    :param key: the launch's, which the agent is configured with; hexadecimal.
    :param interval: seconds between heartbeats.
    """

    def __init__(
        self, address: str, port: int, key: str,
        interval: float = HEARTBEAT_INTERVAL,
    ) -> None:
        self._target = (address, port)
        self._key = key
        self._interval = interval
        self._stopped = threading.Event()
        self._answered_at: Optional[float] = None
        self._round_trip: Optional[float] = None
        self._offsets = OffsetFilter()
        self._offset: Optional[ClockOffset] = None
        self._thread = threading.Thread(target=self._run, name='fogros2-heartbeat', daemon=True)
        self._thread.start()

    @property
    def round_trip(self) -> Optional[float]:
        """Round-trip time of the last answered heartbeat in seconds, None before the first."""
        return self._round_trip

    @property
    def clock_offset(self) -> Optional[ClockOffset]:
        """The best of the recent measurements; None before the first."""
        return self._offset

    @property
    def age(self) -> Optional[float]:
        """Seconds since the last answer, None before the first."""
        at = self._answered_at
        return None if at is None else time.monotonic() - at

    def close(self) -> None:
        """Stop; the agent's watchdog then acts after its ``robot_timeout``."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            number = 0
            while not self._stopped.is_set():
                number += 1
                self._send(link, number)
                self._listen(link, time.monotonic() + self._interval)

    def _send(self, link: socket.socket, number: int) -> None:
        now = time.monotonic()
        with contextlib.suppress(OSError):  # no route while the VPN is down
            link.sendto(sign(self._key, BEAT.pack(number, now)), self._target)

    def _listen(self, link: socket.socket, until: float) -> None:
        while not self._stopped.is_set():
            remaining = until - time.monotonic()
            if remaining <= 0:
                return
            link.settimeout(min(remaining, 0.25))
            try:
                data, peer = link.recvfrom(DATAGRAM)
            except TimeoutError:
                continue
            except OSError:
                # 'connection refused' because the agent does not listen yet; retry
                self._stopped.wait(0.05)
                continue
            now = time.monotonic()
            answer = verify(self._key, ANSWER, data)
            if answer is None or peer != self._target:
                continue
            _, sent, clock = answer
            if not (abs(sent) <= LARGEST and abs(clock) <= LARGEST):
                continue
            round_trip = now - sent
            self._round_trip, self._answered_at = round_trip, now
            if 0 <= round_trip < LONGEST:
                self._offset = self._offsets.add(round_trip, time.time(), clock)
