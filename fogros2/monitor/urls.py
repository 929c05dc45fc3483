# SPDX-License-Identifier: Apache-2.0
"""Where a browser sees what a bridge serves."""

from __future__ import annotations

import urllib.parse

#: Port on which viewers expect a bridge.
PORT = 8765
#: Foxglove's application, and Lichtblick's, as their makers host them, and what a browser says in
#: ``Origin`` for their pages.
FOXGLOVE = 'https://app.foxglove.dev/~/view'
LICHTBLICK = 'https://lichtblick-suite.github.io/lichtblick/'
APPLICATIONS = ('https://app.foxglove.dev', 'https://lichtblick-suite.github.io')
#: Lichtblick as a container, which serves HTTP on port 8080. By digest: it is what it was when it
#: was chosen, or it isn't taken.
IMAGE = ('ghcr.io/lichtblick-suite/lichtblick@sha256:'
         'ebaff0942173dc42c221ec0cc14d2bd7e6591e27c16cd11c8b2e557ce8da28d9')


def guarded_port(port: int) -> int:
    """Return the port at which others than the robot are let in, beside a bridge's own."""
    return port + 1


def application_port(port: int) -> int:
    """Return the port of the loopback that the web application has, beside a bridge's own."""
    return port + 2


def place(host: str, port: int) -> str:
    """Return ``host:port``, an IPv6 address in brackets."""
    return f'[{host}]:{port}' if ':' in host else f'{host}:{port}'


def bridge(host: str, port: int) -> str:
    """Return a bridge's address without its token."""
    return f'ws://{place(host, port)}'


def with_token(where: str, token: str, scheme: str = 'ws') -> str:
    """
    Return the address that opens a bridge.

    :param where: ``host:port``.
    :param scheme: 'wss' at the port for others than the robot.
    """
    return f'{scheme}://{where}/?{urllib.parse.urlencode({"token": token})}'


def app(address: str, at: str = FOXGLOVE) -> str:
    """
    Return a web application's address that opens a bridge.

    A page that came over HTTPS may open ``ws://`` on this computer's loopback alone.

    :param address: the bridge's.
    :param at: the application's; Lichtblick takes the same.
    """
    query = urllib.parse.urlencode({'ds': 'foxglove-websocket', 'ds.url': address})
    return f'{at}?{query}'


def served(where: str, token: str) -> str:
    """
    Return the address at which the gate before a bridge serves the application itself.

    Where the machine has none, a page is there that leads to those above.

    :param where: ``host:port``.
    """
    page = app(with_token(where, token), f'http://{where}/')
    return f'{page}&{urllib.parse.urlencode({"token": token})}'
