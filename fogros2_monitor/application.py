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

#: Port of the application inside the container.
INSIDE = 8080
#: Time-outs of an image download and of any other call of the engine, in seconds.
PULL, CALL = 900.0, 60.0
#: Time-out of the container's start, until it listens, in seconds.
READY = 30.0
ENGINES = ('podman', 'docker')


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
        self._engine = next((name for name in ENGINES if process.which(name)), '')

    def start(self) -> None:
        """
        Start the container; download its image first if necessary.

        :raises FogError: the container cannot start.
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
        # Lichtblick's server has this file capability, and does not start without it.
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
        # As root, because the login user may not be in docker's group.
        return Command((self._engine, *words), sudo=True, what='run the web application')

    def _call(self, *words: str, timeout: float = CALL) -> None:
        process.run(self._command(*words), timeout=timeout, cancel=self._ended)

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
    except CommandError as error:
        # The last line of the engine's error output has the cause.
        said = error.result.stderr.strip().splitlines() or [str(error)]
        say(f'no web application here: {said[-1]}')
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
