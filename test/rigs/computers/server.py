# SPDX-License-Identifier: Apache-2.0
"""
The process behind a box: an API, the computers and the network; told what to do by its parent.

It reads JSON lines and answers each with one. When its input ends, the parent has closed the box
or has died, and everything is taken away.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Mapping, Sequence
import contextlib
import dataclasses
import io
import json
import os
from pathlib import Path
import re
import signal
import sys
import threading
from typing import Any, ClassVar, TypeVar

from fogros2.errors import FogError
from rigs import serving
from rigs.computers import computer, netns, network
from rigs.computers.cloud import Cloud
from rigs.computers.network import Network, ROUTER

Computers = TypeVar('Computers', bound=Cloud)

PORT = 5000
#: Where the robot's network namespace finds names.
_NETNS_FILES = Path('/etc/netns')


def main(kind: type[Box]) -> None:
    """Be a box until the input ends."""
    settings = json.loads(sys.stdin.readline())
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # the parent alone decides; a Ctrl-C in the terminal is the test's
        signal.signal(number, signal.SIG_IGN)
    for mark in computer.left_over():
        sweep(mark)
    kind(settings).run()


def sweep(mark: str) -> None:
    """Take away what a box has left behind."""
    network.sweep(mark)
    with contextlib.suppress(OSError):
        for path in (_NETNS_FILES / f'{network.PREFIX}{mark}r').glob('*'):
            path.unlink()
        (_NETNS_FILES / f'{network.PREFIX}{mark}r').rmdir()
        _NETNS_FILES.rmdir()
    computer.sweep(mark)
    with contextlib.suppress(OSError):
        computer.DISKS.rmdir()


class Box(abc.ABC):
    """
    One box.

    :param settings: ``mark``, ``mounts``, ``regions`` and ``volumes``.
    """

    #: Host of a region's API, with ``{}`` for the region.
    region_host: ClassVar[str]

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.mark = str(settings['mark'])
        self.settings = settings
        self.net = Network(self.mark)

    def computers(self, kind: type[Computers]) -> Computers:
        """Return the computers, of a cloud's class."""
        return kind(self.mark, self.net, mounts=tuple(self.settings['mounts']),
                    volumes=self.settings['volumes'])

    @abc.abstractmethod
    def open(self) -> tuple[Cloud, Any]:
        """Return the computers, and the API: a WSGI application with ``calls``."""

    @abc.abstractmethod
    def shown(self, machine: Any) -> dict[str, Any]:
        """Return what the parent gets of an instance."""

    def do(self, order: Mapping[str, Any]) -> Any:
        """Carry out an order that only this cloud knows."""
        raise ValueError(f'no such order: {order["do"]}')

    def run(self) -> None:
        """Open everything, do what the parent says, and take everything away."""
        folder = computer.DISKS / self.mark
        folder.mkdir(parents=True)
        (folder / 'owner').write_text(f'{os.getpid()} {computer.started(os.getpid())}')
        try:
            self.net.open()
            self._names()
            self._serve()
        except BaseException as error:
            say({'ok': False, 'error': f'{type(error).__name__}: {error}'})
            raise
        finally:
            if hasattr(self, 'cloud'):
                self.cloud.close()
            sweep(self.mark)
        say({'ok': True, 'value': 'closed'})

    def _names(self) -> None:
        """Let the robot find the regions' API hosts at the router, as a DNS server would."""
        folder = _NETNS_FILES / self.net.robot
        folder.mkdir(parents=True)
        names = ''.join(f'{ROUTER} {self.region_host.format(region)}\n'
                        for region in self.settings['regions'])
        (folder / 'hosts').write_text(Path('/etc/hosts').read_text() + names)
        # nobody answers there; the computer's own servers would be asked otherwise
        (folder / 'resolv.conf').write_text(f'nameserver {ROUTER}\n')

    def _serve(self) -> None:
        self.cloud, self.api = self.open()
        inside = netns.listener(self.net.router, ROUTER, PORT)
        # accepts connections and answers nothing: the nearest region is the quickest to connect
        regions = netns.listener(self.net.router, ROUTER, 443)
        self.slow = Slow(checkip(self.api))
        app = self.slow
        servers = [serving.server(app),
                   serving.server(app, ROUTER, PORT, fd=os.dup(inside.fileno()))]
        for server in servers:
            threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True).start()
        threading.Thread(target=_hang_up, args=(regions,), daemon=True).start()
        say({'ok': True, 'value': {'port': servers[0].port, 'robot': self.net.robot}})
        for line in sys.stdin:
            try:
                say({'ok': True, 'value': self._do(json.loads(line))})
            except (FogError, KeyError, OSError, ValueError) as error:
                say({'ok': False, 'error': f'{type(error).__name__}: {error}'})
        for server in servers:
            server.shutdown()

    def _do(self, order: Mapping[str, Any]) -> Any:
        what = order['do']
        if what == 'calls':
            return [dataclasses.asdict(call) for call in list(self.api.calls)]
        elif what == 'clear_calls':
            self.api.calls.clear()
        elif what == 'instances':
            return [{**self.shown(machine), 'spot': machine.spot, 'computer': machine.runs,
                     'asked': machine.asked, 'ready': machine.ready}
                    for machine in list(self.cloud.machines.values())]
        elif what == 'run':
            return self.cloud.machines[order['instance']].computer.run(
                order['script'], check=order['check'])
        elif what == 'user data':
            return self.cloud.user_data(self.cloud.machines[order['instance']]).hex()
        elif what == 'interrupt':
            self.cloud.interrupt(order['instance'], order['notice'])
        elif what == 'move_robot':
            self.net.move_robot(order['address'])
        elif what == 'slow':
            self.slow.order(order['pattern'], float(order['seconds']))
        elif what == 'held':
            return self.slow.held
        elif what == 'boot_delay':
            self.cloud.boot_delay = float(order['seconds'])
        else:
            return self.do(order)
        return None


class Slow:
    """
    A WSGI application that holds requests back, and carries them out then, answered or not.

    :ivar pattern: of the requests: their method, path and body; '' for none.
    :ivar held: number of the requests that are held back now, or are being carried out then.
    """

    def __init__(self, inner: Callable[..., Iterable[bytes]]) -> None:
        self._inner = inner
        self.pattern, self.seconds, self.held = '', 0.0, 0
        self._changed = threading.Condition()

    def order(self, pattern: str, seconds: float) -> None:
        """Hold requests back from now on; without a pattern none, and no more those that are."""
        with self._changed:
            self.pattern, self.seconds = pattern, seconds
            self._changed.notify_all()

    def __call__(
        self, environ: dict[str, Any], start_response: Callable[..., Any],
    ) -> Iterable[bytes]:
        """Answer a request, late if it fits."""
        body = environ['wsgi.input'].read(int(environ.get('CONTENT_LENGTH') or 0))
        environ['wsgi.input'] = io.BytesIO(body)
        words = f"{environ['REQUEST_METHOD']} {environ['PATH_INFO']} {body.decode('latin-1')}"
        if not self.pattern or not re.search(self.pattern, words):
            return self._inner(environ, start_response)
        with self._changed:
            self.held += 1
            self._changed.wait_for(lambda: not self.pattern, self.seconds)
        try:
            return self._inner(environ, start_response)
        finally:
            with self._changed:
                self.held -= 1


def checkip(inner: Callable[..., Iterable[bytes]]) -> Callable[..., Iterable[bytes]]:
    """Return a WSGI application that also tells callers of ``/checkip`` their own address."""
    def answer(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        if environ.get('PATH_INFO') != '/checkip':
            return inner(environ, start_response)
        body = f"{environ['REMOTE_ADDR']}\n".encode()
        headers: Sequence[tuple[str, str]] = [
            ('Content-Type', 'text/plain'), ('Content-Length', str(len(body)))]
        start_response('200 OK', headers)
        return [body]

    return answer


def _hang_up(listener: Any) -> None:
    while True:
        connection, _ = listener.accept()
        connection.close()


def say(data: Mapping[str, Any]) -> None:
    """Answer the parent, if it is still there."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(data), flush=True)
