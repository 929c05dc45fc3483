# SPDX-License-Identifier: Apache-2.0
"""
Run the web application as a container beside the bridge, until standard input is closed.

The machine needs a container engine, and the image or access to its registry. If the application
cannot start, this program reports why, and the gate's page links to hosted applications instead.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import contextlib
import functools
import signal
import socket
import sys
import threading
from typing import Optional

from fogros2.errors import Cancelled, FogError
from fogros2.provider.container import engine as container_engine
from fogros2.waiting import wait_until

#: Port of the application inside the container.
INSIDE = 8080
#: Time-out of an image download in seconds.
PULL = 900.0
#: Time-out of the container's start, until it listens, in seconds.
READY = 30.0


class Application:
    """
    One container of the web application.

    :param port: loopback port of the application.
    :param ended: event that cancels the start.
    """

    def __init__(self, image: str, port: int, ended: threading.Event) -> None:
        self._image = image
        self._port = port
        self._ended = ended
        # A fixed name, so that a container that survived a crash is replaced.
        self._name = f'fogros2-application-{port}'
        self._engine: Optional[container_engine.Engine] = None

    def start(self) -> None:
        """
        Start the container; download its image first if necessary.

        :raises FogError: the container cannot start.
        """
        engine = self._engine = container_engine.select('auto', self._image)
        call = functools.partial(engine.call, what='run the web application', cancel=self._ended)
        if call('image', 'inspect', self._image, check=False).returncode != 0:
            say(f'getting {self._image}')
            call('pull', '-q', self._image, timeout=PULL)
        self.stop()
        # Lichtblick's server has this file capability, and does not start without it.
        call('run', '-d', '--name', self._name, '--stop-timeout', '0',
             '--cap-drop', 'all', '--cap-add', 'NET_BIND_SERVICE',
             '--security-opt', 'no-new-privileges', *container_engine.limits(),
             '-p', f'127.0.0.1:{self._port}:{INSIDE}', self._image)
        wait_until(self._listens, timeout=READY, cancel=self._ended,
                   what=f'{self._image} to listen on its port {INSIDE}')

    def stop(self) -> None:
        """Remove the container, if there is one."""
        if self._engine is not None:
            self._engine.call('rm', '-f', self._name, what='stop the web application', check=False)

    def _listens(self) -> Optional[bool]:
        with contextlib.suppress(OSError), socket.create_connection(
                ('127.0.0.1', self._port), timeout=1.0):
            return True
        return None


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """Run until standard input is closed, or until a signal."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--image', required=True)
    parser.add_argument('--port', type=int, required=True, help='of the loopback')
    parser.add_argument('--name', required=True, help="the machine's")
    options = parser.parse_args(arguments)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    threading.Thread(target=_until_eof, args=(ended,), daemon=True).start()
    application = Application(options.image, options.port, ended)
    try:
        _start(application, options.name)
        ended.wait()
    finally:
        application.stop()


def _start(application: Application, name: str) -> None:
    """Start the application, and report how to open it or why there is none."""
    try:
        application.start()
        say(f'the web application is there: ros2 fog monitor {name}')
    except Cancelled:
        pass
    except FogError as error:
        say(f'no web application here: {error}')


def say(text: str) -> None:
    """Print to standard error: a launch shows standard output only in its log file."""
    print(text, file=sys.stderr, flush=True)


def _until_eof(ended: threading.Event) -> None:
    sys.stdin.buffer.read()  # the parent never writes, so this returns when the parent ends
    ended.set()


if __name__ == '__main__':
    main()
