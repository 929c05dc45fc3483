# SPDX-License-Identifier: Apache-2.0
"""
Start the bridge on a machine, with its gate and the web application.

    ros2 run fogros2 bridge [these options, and the gate's] --ros-args [the bridge's parameters]

``--topic PATTERN``     topics, services and parameters to show; default: all
``--secrets FOLDER``    folder of the token and the TLS files, created if missing
``--public PORT``       also open this port to other computers, over TLS
``--image IMAGE``       image of the web application, '' for none

The bridge (:mod:`~fogros2_monitor.bridge`) needs no token, so it listens on a random address and
port of 127.0.0.0/8 that no web page can guess. Viewers connect to the gate's ports. Gate and
application end when this process ends, even if it is killed. This process ends when its gate ends,
so that the launch starts both again.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
import secrets
import socket
import subprocess
import sys

from fogros2.errors import FogError
from fogros2.python_module import RUN_MODULE
from fogros2_monitor import credentials
from fogros2_monitor.addresses import application_port
from fogros2_monitor.application import say

#: Address of the web application; it is no secret, as the application has no data and no token.
_LOOPBACK = '127.0.0.1'


def hidden_place() -> tuple[str, int]:
    """Return a random one of 16 million loopback addresses, and a free port there."""
    address = '.'.join(['127', *(str(1 + secrets.randbelow(254)) for _ in range(3))])
    with socket.create_server((address, 0)) as probe:
        return address, int(probe.getsockname()[1])


def public_port(port: int, folder: str, name: str) -> list[str]:
    """
    Return the gate's options for other computers; none if the certificate cannot be created.

    :param port: port to open.
    :param folder: folder of the certificate.
    :param name: name of the machine.
    """
    try:
        made = credentials.make(Path(folder), name)
    except (FogError, OSError) as error:
        say(f'nobody but the robot is let in: {error}')
        return []
    say('the certificate has the SHA-256 '
        + credentials.fingerprint(made.certificate.read_text()))
    return ['--public', f':{port}', '--certificate', str(made.certificate),
            '--key', str(made.key)]


def main() -> None:
    """Start gate and application, then replace this process by the bridge."""
    words = sys.argv[1:]
    at = words.index('--ros-args') if '--ros-args' in words else len(words)
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument('--topic', action='append', default=[])
    parser.add_argument('--vpn', type=int)
    parser.add_argument('--public', type=int)
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
    if ours.public is not None:
        gate += public_port(ours.public, folder, ours.name)
    address, port = hidden_place()
    end, kept = os.pipe()
    ended, alive = os.pipe()  # the gate keeps the second end open, and the bridge reads
    os.set_inheritable(kept, True)  # the bridge keeps this end open; at its end the others exit
    application = []
    if ours.image and ours.vpn is not None:
        inside = application_port(ours.vpn)
        gate += ['--application', f'{_LOOPBACK}:{inside}', '--ready', str(alive)]
        application = ['--image', ours.image, '--port', str(inside), '--name', ours.name]
    subprocess.Popen(
        [*RUN_MODULE, 'fogros2_monitor.gate', '--to', f'{address}:{port}',
         '--until-eof', *gate], stdin=end, pass_fds=[alive])
    os.close(alive)
    # where the gate of another launch has the port, that launch's application stays
    if application and os.read(ended, 1):
        subprocess.Popen([*RUN_MODULE, 'fogros2_monitor.application', *application],
                         stdin=end)
    os.close(end)
    os.set_inheritable(ended, True)
    os.execv(sys.executable, [
        *RUN_MODULE, 'fogros2_monitor.bridge', '--ros-args', *words[at + 1:],
        '-p', f'address:={address}', '-p', f'port:={port}', '-p', f'gate:={ended}',
        '-p', f'topics:={json.dumps(ours.topic or ["*"])}'])


if __name__ == '__main__':
    main()
