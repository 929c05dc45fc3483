# SPDX-License-Identifier: Apache-2.0
"""Choose between UDP and the stream while a launch runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
from pathlib import Path
import socket
import threading
import time
from typing import Any, Optional, TYPE_CHECKING

from fogros2 import shell as shells
from fogros2.errors import ConfigurationError, FogError, ShellError
from fogros2.feature import Feature, VpnLink
from fogros2.model import Command, host_port, MachineSpec
from fogros2.waiting import Periodic
from fogros2_features.vpn_path import carrier
from fogros2_features.vpn_path.carrier import Carrier

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

AUTO, UDP, STREAM = 'auto', 'udp', 'stream'
#: Seconds for the first answer by UDP, and without an answer later: WireGuard repeats a handshake
#: after 5 s, so two are missing.
FIRST, MISSING = 3.0, 10.0
#: Seconds for which UDP has to work before the VPN goes back to it.
WORKING = 10.0
#: Seconds for which packets are sent by both paths until UDP answers: a heartbeat is among them.
#: Seconds until the next attempt, at first and at the most.
TRIAL, SHORTEST, LONGEST = 2.5, 5.0, 60.0
#: Seconds without progress after which a stream is opened anew.
STALLED = 5.0
#: Seconds to connect and for the program's first line, and between two attempts.
OPENING, PAUSE = 10.0, 2.0
#: Seconds between two decisions, and while UDP works.
INTERVAL, STEADY = 0.1, 1.0


def choose(own: str, path: str, *, answered: bool, silence: float, working: float) -> str:
    """
    Return the path to use from now on.

    :param own: the value of ``vpn_path``.
    :param path: the current one.
    :param answered: whether anything has come back through the VPN so far.
    :param silence: seconds since the last answer, or since the first attempt.
    :param working: seconds for which UDP has worked beside the stream.
    """
    if own != AUTO:
        return own
    if path == UDP:
        return STREAM if silence > (MISSING if answered else FIRST) else UDP
    return UDP if working >= WORKING else STREAM


class Trial:
    """
    Find out whether UDP works while the stream carries the VPN.

    Packets go by both ways for a moment. The machine's WireGuard takes the first copy of each, and
    answers to where that came from.

    :param endpoint: ``host:port`` of the machine's WireGuard, None if the robot can't dial it.
    :param answer: called with what came by UDP.
    :param pause: seconds before the first attempt; each further pause is twice as long.
    """

    def __init__(
        self, endpoint: Optional[str], answer: Callable[[bytes], object], pause: float,
    ) -> None:
        self._answer = answer
        self._link: Optional[socket.socket] = None
        self._pause = pause
        self._next = time.monotonic() + pause
        self._began: Optional[float] = None
        self._last = 0.0
        with contextlib.suppress(OSError):  # a name that is unknown without a network
            if endpoint is not None:
                host, _, port = endpoint.rpartition(':')
                (family, kind, _, _, address), *_ = socket.getaddrinfo(
                    host.strip('[]'), int(port), type=socket.SOCK_DGRAM)
                self._link = socket.socket(family, kind)
                self._link.connect(address)
                threading.Thread(target=self._listen, name='fog-trial', daemon=True).start()

    def copy(self, data: bytes) -> None:
        """Send a copy of a packet by UDP, during an attempt."""
        if self._link is not None and time.monotonic() >= self._next:
            with contextlib.suppress(OSError):
                self._link.send(data)

    def working(self, now: float) -> float:
        """Return the seconds for which UDP has answered; begin and end attempts."""
        if now < self._next:
            return 0.0
        if now - max(self._next, self._last) > TRIAL:
            self._began = None
            self._pause = min(2 * self._pause, LONGEST)
            self._next = now + self._pause
        return now - self._began if self._began is not None else 0.0

    def _listen(self) -> None:
        assert self._link is not None
        for data in carrier.datagrams(self._link):
            self._last = time.monotonic()
            self._began = self._began or self._last
            self._answer(data)

    def close(self) -> None:
        """End."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.shutdown(socket.SHUT_RDWR)


class Way:
    """
    The way of a machine's VPN, as long as its launch uses the machine.

    :param own: the value of ``vpn_path``.
    :raises FogError: it is 'stream', and the stream can't be opened.
    """

    def __init__(self, link: VpnLink, own: str) -> None:
        self._link = link
        self._own = own
        self._began = time.monotonic()
        self._undo = contextlib.ExitStack()
        self._carrier: Optional[Carrier] = None
        self._trial: Optional[Trial] = None
        self._path = UDP
        #: Longer after each return to UDP, which may work for a while only.
        self._pause = SHORTEST
        self._stop = threading.Event()
        #: Guards what has to be undone, and changes of the path, which end with the way.
        self._lock = threading.Lock()
        if own == STREAM:
            try:
                self._open()
            except BaseException:
                self.close()
                raise
        Periodic('fog-path', INTERVAL, self._look, stop=self._stop)

    def close(self) -> None:
        """End, without a change of the path: the VPN ends too."""
        self._stop.set()
        with self._lock:
            self._undo.close()

    def _look(self) -> Optional[float]:
        """Change the path if it is time to; return the seconds until the next look, if long."""
        now, age = time.monotonic(), self._link.silence
        working = self._trial.working(now) if self._trial is not None else 0.0
        target = choose(
            self._own, self._path, answered=age is not None, working=working,
            silence=now - self._began if age is None else age)
        current = self._carrier
        if current is not None and (current.over or (
                current.window.under_way and now - current.window.heard > STALLED)):
            self._end()
        try:
            if target == STREAM and self._carrier is None:
                self._open()
            elif target != self._path:
                self._use(UDP, '')
                self._end()
                self._pause = min(2 * self._pause, LONGEST)
            elif target == UDP and age is not None:
                self._link.close_outside()
        except (FogError, OSError) as error:
            self._link.advise(f'the stream in place of UDP failed: {error}')
            self._end()
            if self._own == AUTO and self._path == STREAM:
                with contextlib.suppress(FogError):  # tried again
                    self._use(UDP, '')
            return PAUSE
        return STEADY if self._path == UDP and age is not None else None

    def _use(self, path: str, relay: str) -> None:
        with self._lock:
            if not self._stop.is_set():
                with self._link.step('VPN path') as detail:
                    self._link.dial(relay, path if relay else '')
                    detail.append(path)
                self._path = path

    def _end(self) -> None:
        with self._lock:
            self._carrier = self._trial = None
            self._undo.close()

    def _open(self) -> None:
        """
        Open the stream, and let the robot's WireGuard use it.

        :raises FogError: it can't be opened.
        """
        link = self._link
        # a connection of its own: packets would wait there for files and commands
        shell = shells.connect(link.open_outside(), name=link.spec.name, timeout=OPENING)
        self._push(shell.close)
        stream = shell.open(Command(
            ('python3', '-IS', '-c', Path(carrier.__file__).read_text(), str(link.port)),
            what='carry the VPN'))
        self._push(stream.close)
        late = threading.Timer(OPENING, stream.close)
        late.daemon = True
        late.start()
        first = stream.readline()
        late.cancel()
        if first != carrier.READY:
            raise ShellError(f"'{link.spec.name}' does not run the program that carries the VPN")
        trial = Trial(link.direct if self._own == AUTO else None,
                      lambda data: carried.deliver(data), self._pause)
        self._push(trial.close)
        carried = Carrier(link.robot_port, stream.write, stream.readline, trial.copy)
        self._push(carried.close)
        threading.Thread(target=carried.run, name='fog-carry', daemon=True).start()
        self._carrier, self._trial = carried, trial
        self._use(STREAM, host_port(*carried.address))

    def _push(self, undo: Callable[[], object]) -> None:
        with self._lock:
            self._undo.callback(undo)
            if self._stop.is_set():
                self._undo.close()


class VpnPath(Feature):
    """``vpn_path='stream'``: how the packets of a machine's VPN travel."""

    always = True

    @staticmethod
    def options(vpn_path: Optional[SomeSubstitutionsType] = None) -> str:
        """
        Return the path.

        :param vpn_path: 'udp', 'stream' for the connection of the machine's shell, or 'auto' for
            UDP where it works.
        """
        path = str(vpn_path or AUTO)
        if path not in (AUTO, UDP, STREAM):
            raise ConfigurationError(f"vpn_path='{path}' is no path of a VPN",
                                     "use 'auto', 'udp' or 'stream'")
        return path

    def check(self, spec: MachineSpec, own: str) -> None:
        """Refuse a stream to another robot's machine, whose shell is in its VPN."""
        if own == STREAM and spec.provider == 'joined':
            raise ConfigurationError(
                f"'{spec.name}' can't have vpn_path='stream': its shell is reached by its VPN",
                'leave vpn_path= out')

    @contextlib.contextmanager
    def vpn(self, link: VpnLink, own: str) -> Iterator[None]:
        """Watch the path."""
        if own == UDP:
            link.advise("vpn_path='auto' or 'stream' goes by the connection of the shell")
            yield
            return
        way = Way(link, own)
        try:
            yield
        finally:
            way.close()

    def status(self, shown: Mapping[str, Any], own: str) -> Iterable[tuple[str, str]]:
        """Return the path that is in use."""
        vpn = shown['vpn']
        return [('VPN path', vpn['carried'] or UDP)] if vpn is not None else []
