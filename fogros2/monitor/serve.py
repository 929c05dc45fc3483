# SPDX-License-Identifier: Apache-2.0
"""
Starts the bridge on a machine, with the gate before it.

    ros2 run fogros2 bridge [the gate's options] --ros-args [the bridge's parameters]

Where ROS 2's own ``foxglove_bridge`` is installed that runs, otherwise
:mod:`~fogros2.monitor.bridge`. Either listens on a free port of the loopback; the gate has the
port that viewers know, and ends when this process does, however that ends.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
import socket
import subprocess
import sys

from ament_index_python.packages import get_package_prefix, PackageNotFoundError

#: What the parameter ``topics`` is called by ``foxglove_bridge``, which takes regular expressions.
_WHITELIST = 'topic_whitelist'
_LOOPBACK = '127.0.0.1'


def foxglove_bridge() -> str:
    """Return the path of ROS 2's bridge, '' where it isn't installed."""
    try:
        path = os.path.join(
            get_package_prefix('foxglove_bridge'), 'lib', 'foxglove_bridge', 'foxglove_bridge')
    except PackageNotFoundError:
        return ''
    return path if os.access(path, os.X_OK) else ''


def regular_expression(pattern: str) -> str:
    r"""
    Return a pattern with ``*`` and ``?`` as ECMAScript's regular expressions write it.

    >>> regular_expression('/camera/*')
    '/camera/.*'
    """
    return ''.join({'*': '.*', '?': '.'}.get(c, c if c.isalnum() or c in '/_' else f'\\{c}')
                   for c in pattern)


def command(port: int, theirs: str, patterns: Sequence[str], ros_arguments: Sequence[str]) -> (
        list[str]):
    """
    Return the words that run a bridge.

    :param port: of the loopback.
    :param theirs: the path of ``foxglove_bridge``, '' for our own.
    :param patterns: of the topics that are shown.
    """
    program = [theirs] if theirs else [sys.executable, '-m', 'fogros2.monitor.bridge']
    name, values = ('topics', list(patterns)) if not theirs else (
        _WHITELIST, [regular_expression(pattern) for pattern in patterns])
    return [*program, '--ros-args', *ros_arguments, '-p', f'address:={_LOOPBACK}',
            '-p', f'port:={port}', '-p', f'{name}:={json.dumps(values)}']


def _free_port() -> int:
    with socket.create_server((_LOOPBACK, 0)) as probe:
        port: int = probe.getsockname()[1]
    return port


def main() -> None:
    """Start the gate, and become the bridge."""
    words = sys.argv[1:]
    at = words.index('--ros-args') if '--ros-args' in words else len(words)
    ours, ros_arguments = words[:at], words[at + 1:]
    patterns = [word for option, word in zip(ours, ours[1:]) if option == '--topic'] or ['*']
    gate = [word for index, word in enumerate(ours)
            if word != '--topic' and (index == 0 or ours[index - 1] != '--topic')]
    port = _free_port()
    end, kept = os.pipe()
    os.set_inheritable(kept, True)  # by the bridge: when it is closed the gate ends
    subprocess.Popen(
        [sys.executable, '-m', 'fogros2.monitor.gate', '--to', f'{_LOOPBACK}:{port}',
         '--until-eof', *gate], stdin=end)
    os.close(end)
    words = command(port, foxglove_bridge(), patterns, ros_arguments)
    os.execv(words[0], words)


if __name__ == '__main__':
    main()
