# SPDX-License-Identifier: Apache-2.0
"""
Starts the bridge on a machine, with the gate before it and the web application beside it.

    ros2 run fogros2 bridge [these options, and the gate's] --ros-args [the bridge's parameters]

``--topic PATTERN``     topics that are shown, all unless given
``--guarded PORT``      lets others than the robot in there, over TLS and with a token
``--secrets FOLDER``    where certificate, key and token for that are, or are made
``--image IMAGE``       the web application's, '' for none

Where ROS 2's own ``foxglove_bridge`` is installed that runs, otherwise
:mod:`~fogros2.monitor.bridge`. Either listens on a free port of the loopback; the gate has the
port that viewers know. Gate and application end when this process does, however that ends.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
import os
from pathlib import Path
import socket
import subprocess
import sys

from ament_index_python.packages import get_package_prefix, PackageNotFoundError

from fogros2.errors import FogError
from fogros2.monitor import credentials, urls
from fogros2.monitor.application import say
from fogros2.monitor.gate import VPN_ADDRESS

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


def guard(port: int, folder: str, name: str) -> list[str]:
    """
    Return the gate's options for letting others in, none where there can be no certificate.

    :param folder: where it is, or is made.
    :param name: the machine's.
    """
    try:
        made = credentials.make(Path(folder), name)
    except (FogError, OSError) as error:
        say(f'nobody but the robot is let in: {error}')
        return []
    say('the certificate has the SHA-256 '
        + credentials.fingerprint(made.certificate.read_text()))
    return ['--guarded', f':{port}', '--certificate', str(made.certificate),
            '--key', str(made.key), '--token-file', str(made.token)]


def main() -> None:
    """Start what stands beside the bridge, and become it."""
    words = sys.argv[1:]
    at = words.index('--ros-args') if '--ros-args' in words else len(words)
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument('--topic', action='append', default=[])
    parser.add_argument('--vpn', type=int)
    parser.add_argument('--guarded', type=int)
    parser.add_argument('--secrets', default='')
    parser.add_argument('--image', default='')
    parser.add_argument('--name', default=socket.gethostname())
    ours, gate = parser.parse_known_args(words[:at])
    gate += ['--name', ours.name]
    if ours.vpn is not None:
        gate += ['--vpn', str(ours.vpn)]
    if ours.guarded is not None:
        folder = os.path.expandvars(ours.secrets)
        gate += guard(ours.guarded, folder, ours.name)
    port = _free_port()
    end, kept = os.pipe()
    os.set_inheritable(kept, True)  # by the bridge: when it is closed the others end
    if ours.image and ours.vpn is not None:
        inside = urls.application_port(ours.vpn)
        gate += ['--application', f'{_LOOPBACK}:{inside}']
        subprocess.Popen(
            [sys.executable, '-m', 'fogros2.monitor.application', '--image', ours.image,
             '--port', str(inside),
             '--at', urls.served(os.environ.get(VPN_ADDRESS, 'localhost'), ours.vpn)], stdin=end)
    subprocess.Popen(
        [sys.executable, '-m', 'fogros2.monitor.gate', '--to', f'{_LOOPBACK}:{port}',
         '--until-eof', *gate], stdin=end)
    os.close(end)
    words = command(port, foxglove_bridge(), ours.topic or ['*'], words[at + 1:])
    os.execv(words[0], words)


if __name__ == '__main__':
    main()
