# SPDX-License-Identifier: Apache-2.0
"""
Runs the web application as a container beside the bridge, for as long as its input is open.

Only where the machine has an engine, and the image or a way to get it: what doesn't work is said,
and the gate's page leads to the applications that others host.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import contextlib
import signal
import socket
import sys
import threading
from typing import Optional

from fogros2 import process
from fogros2.errors import Cancelled, CommandError, FogError, PrerequisiteError
from fogros2.model import Command
from fogros2.provider import container_engine
from fogros2.waiting import wait_until

#: Port on which the image serves.
INSIDE = 8080
#: Seconds in which an image has to come, and those that the engine may take for anything else.
PULL, CALL = 900.0, 60.0
#: Seconds in which what was started has to listen.
READY = 30.0
ENGINES = ('podman', 'docker')


class Application:
    """
    One container.

    :param port: of the loopback.
    :param ended: set when it is to end.
    """

    def __init__(self, image: str, port: int, ended: threading.Event) -> None:
        self._image = image
        self._port = port
        self._ended = ended
        # one that a crash of the computer has left is replaced
        self._name = f'fogros2-application-{port}'
        self._engine = next((name for name in ENGINES if process.which(name)), '')

    def start(self) -> None:
        """
        Start it, its image downloaded first if it isn't there.

        :raises FogError: that doesn't work.
        """
        if not self._engine:
            raise PrerequisiteError(
                'neither podman nor docker is there', 'sudo apt-get install podman')
        try:
            self._call('image', 'inspect', self._image)
        except CommandError:
            say(f'getting {self._image}')
            self._call('pull', '-q', self._image, timeout=PULL)
        self.stop()
        # Lichtblick's server is a file with this one capability: without, it doesn't start
        self._call('run', '-d', '--name', self._name, '--stop-timeout', '0',
                   '--cap-drop', 'all', '--cap-add', 'NET_BIND_SERVICE',
                   '--security-opt', 'no-new-privileges', *container_engine.limits(),
                   '-p', f'127.0.0.1:{self._port}:{INSIDE}', self._image)
        wait_until(self._listens, timeout=READY, cancel=self._ended,
                   what=f'{self._image} to listen on its port {INSIDE}')

    def stop(self) -> None:
        """Remove the container, if there is one."""
        if self._engine:
            process.run(self._command('rm', '-f', self._name), timeout=CALL, check=False)

    def _command(self, *words: str) -> Command:
        # as root: the login user may not be in docker's group
        return Command((self._engine, *words), sudo=True, what='run the web application')

    def _call(self, *words: str, timeout: float = CALL) -> None:
        process.run(self._command(*words), timeout=timeout, cancel=self._ended)

    def _listens(self) -> Optional[bool]:
        with contextlib.suppress(OSError), socket.create_connection(
                ('127.0.0.1', self._port), timeout=1.0):
            return True
        return None


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """Run until the input ends, or interrupted."""
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
    """Start it and say how people find it, or why there is none: the bridge goes on without."""
    try:
        application.start()
        say(f'the web application is there: ros2 fog monitor {name}')
    except Cancelled:
        pass
    except CommandError as error:
        # the engine's own last words say it best
        said = error.result.stderr.strip().splitlines() or [str(error)]
        say(f'no web application here: {said[-1]}')
    except FogError as error:
        say(f'no web application here: {error}')


def say(text: str) -> None:
    """Tell people; a launch shows what is said on the standard output in its log file alone."""
    print(text, file=sys.stderr, flush=True)


def _until_eof(ended: threading.Event) -> None:
    sys.stdin.buffer.read()  # nothing is ever written there
    ended.set()


if __name__ == '__main__':
    main()
