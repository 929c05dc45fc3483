# SPDX-License-Identifier: Apache-2.0
"""
Starts the bridge on a machine, with the gate before it and the web application beside it.

    ros2 run fogros2 bridge [these options, and the gate's] --ros-args [the bridge's parameters]

``--topic PATTERN``     topics that are shown, all unless given
``--secrets FOLDER``    where the token and what TLS needs are, or are made
``--guarded PORT``      lets others than the robot in there, over TLS
``--image IMAGE``       the web application's, '' for none

Where ROS 2's own ``foxglove_bridge`` is installed that runs, otherwise
:mod:`~fogros2_monitor.bridge`. Either listens on the loopback, at a port and an address of its
net 127.0.0.0/8 that no page in a browser can guess: it takes no token. The gate has the port that
viewers know. Gate and application end when this process does, however that ends.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
import os
from pathlib import Path
import secrets
import socket
import subprocess
import sys

from ament_index_python.packages import get_package_prefix, PackageNotFoundError

from fogros2.errors import FogError
from fogros2.monitor_addresses import application_port
from fogros2_monitor import credentials
from fogros2_monitor.application import say

#: What the parameter ``topics`` is called by ``foxglove_bridge``, which takes regular expressions.
_WHITELIST = 'topic_whitelist'
#: The web application has no data, and no token.
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


def command(
    address: str, port: int, theirs: str, patterns: Sequence[str], ros_arguments: Sequence[str],
) -> list[str]:
    """
    Return the words that run a bridge.

    :param address: of the loopback, as for ``port``.
    :param theirs: the path of ``foxglove_bridge``, '' for our own.
    :param patterns: of the topics that are shown.
    """
    program = [theirs] if theirs else [sys.executable, '-m', 'fogros2_monitor.bridge']
    name, values = ('topics', list(patterns)) if not theirs else (
        _WHITELIST, [regular_expression(pattern) for pattern in patterns])
    return [*program, '--ros-args', *ros_arguments, '-p', f'address:={address}',
            '-p', f'port:={port}', '-p', f'{name}:={json.dumps(values)}']


def hidden_place() -> tuple[str, int]:
    """Return one of 16 million addresses of the loopback's net, and a port that is free there."""
    address = '.'.join(['127', *(str(1 + secrets.randbelow(254)) for _ in range(3))])
    with socket.create_server((address, 0)) as probe:
        return address, int(probe.getsockname()[1])


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
            '--key', str(made.key)]


def main() -> None:
    """Start what stands beside the bridge, and become it."""
    words = sys.argv[1:]
    at = words.index('--ros-args') if '--ros-args' in words else len(words)
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument('--topic', action='append', default=[])
    parser.add_argument('--vpn', type=int)
    parser.add_argument('--guarded', type=int)
    parser.add_argument('--secrets', required=True)
    parser.add_argument('--image', default='')
    parser.add_argument('--name', default=socket.gethostname())
    ours, gate = parser.parse_known_args(words[:at])
    folder = os.path.expandvars(ours.secrets)
    try:
        made = credentials.make_token(Path(folder))
    except OSError as error:
        raise SystemExit(f'the bridge can not write its token to {folder}: {error.strerror}\n'
                         '--secrets names another folder') from error
    gate += ['--name', ours.name, '--token-file', str(made.token)]
    if ours.vpn is not None:
        gate += ['--vpn', str(ours.vpn)]
    if ours.guarded is not None:
        gate += guard(ours.guarded, folder, ours.name)
    address, port = hidden_place()
    end, kept = os.pipe()
    os.set_inheritable(kept, True)  # by the bridge: when it is closed the others end
    if ours.image and ours.vpn is not None:
        inside = application_port(ours.vpn)
        gate += ['--application', f'{_LOOPBACK}:{inside}']
        subprocess.Popen(
            [sys.executable, '-m', 'fogros2_monitor.application', '--image', ours.image,
             '--port', str(inside),
             '--name', ours.name], stdin=end)
    subprocess.Popen(
        [sys.executable, '-m', 'fogros2_monitor.gate', '--to', f'{address}:{port}',
         '--until-eof', *gate], stdin=end)
    os.close(end)
    words = command(address, port, foxglove_bridge(), ours.topic or ['*'], words[at + 1:])
    os.execv(words[0], words)


if __name__ == '__main__':
    main()
