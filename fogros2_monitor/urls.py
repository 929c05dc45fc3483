# SPDX-License-Identifier: Apache-2.0
"""Build the URLs that open a bridge in a viewer."""

from __future__ import annotations

import urllib.parse

#: URLs of the hosted applications, and the values of ``Origin`` that a browser sends for their
#: pages. A link to them has no bridge's URL: their servers would get its token.
FOXGLOVE = 'https://app.foxglove.dev/'
LICHTBLICK = 'https://lichtblick-suite.github.io/lichtblick/'
APPLICATIONS = ('https://app.foxglove.dev', 'https://lichtblick-suite.github.io')
#: How to open a bridge there.
HOW = "'Open connection', 'Foxglove WebSocket', and this address"


def with_token(where: str, token: str, scheme: str = 'ws') -> str:
    """
    Return the URL of a bridge with its token.

    :param where: ``host:port``.
    :param scheme: 'wss' for the port that is open to other computers.
    """
    return f'{scheme}://{where}/?{urllib.parse.urlencode({"token": token})}'


def served(where: str, token: str) -> str:
    """
    Return the URL at which the gate itself serves the web application.

    If the machine has no web application, the gate shows its page with links there.

    :param where: ``host:port``.
    """
    query = urllib.parse.urlencode({
        'ds': 'foxglove-websocket', 'ds.url': with_token(where, token), 'token': token})
    return f'http://{where}/?{query}'
