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


def start(
    image: str, port: int, ended: threading.Event, undo: contextlib.ExitStack,
) -> None:
    """
    Start the container of the web application; download its image first if necessary.

    :param port: loopback port of the application.
    :param ended: event that cancels the start.
    :param undo: gets the call that removes the container.
    :raises FogError: the container cannot start.
    """
    engine = container_engine.select('auto', image)
    call = functools.partial(engine.call, what='run the web application', cancel=ended)
    # A fixed name, so that a container that survived a crash is replaced.
    name = f'fogros2-application-{port}'
    remove = functools.partial(
        engine.call, 'rm', '-f', name, what='stop the web application', check=False)
    if call('image', 'inspect', image, check=False).returncode != 0:
        say(f'getting {image}')
        call('pull', '-q', image, timeout=PULL)
    remove()
    undo.callback(remove)
    # Lichtblick's server has this file capability, and does not start without it.
    call('run', '-d', '--name', name, '--stop-timeout', '0',
         '--cap-drop', 'all', '--cap-add', 'NET_BIND_SERVICE',
         '--security-opt', 'no-new-privileges', *container_engine.limits(),
         '-p', f'127.0.0.1:{port}:{INSIDE}', image)
    wait_until(lambda: _listens(port), timeout=READY, cancel=ended,
               what=f'{image} to listen on its port {INSIDE}')


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(('127.0.0.1', port), timeout=1.0):
        return True
    return False


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
    with contextlib.ExitStack() as undo:
        try:
            start(options.image, options.port, ended, undo)
            say(f'the web application is there: ros2 fog monitor {options.name}')
        except Cancelled:
            pass
        except FogError as error:
            say(f'no web application here: {error}')
        ended.wait()


def say(text: str) -> None:
    """Print to standard error: a launch shows standard output only in its log file."""
    print(text, file=sys.stderr, flush=True)


def _until_eof(ended: threading.Event) -> None:
    sys.stdin.buffer.read()  # the parent never writes, so this returns when the parent ends
    ended.set()


if __name__ == '__main__':
    main()
