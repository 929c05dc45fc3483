# SPDX-License-Identifier: Apache-2.0
"""Addresses that open a bridge in a viewer."""

from __future__ import annotations

import urllib.parse

#: Foxglove's application, and Lichtblick's, as their makers host them, and what a browser says in
#: ``Origin`` for their pages.
FOXGLOVE = 'https://app.foxglove.dev/~/view'
LICHTBLICK = 'https://lichtblick-suite.github.io/lichtblick/'
APPLICATIONS = ('https://app.foxglove.dev', 'https://lichtblick-suite.github.io')

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
