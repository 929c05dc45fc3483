# SPDX-License-Identifier: Apache-2.0
"""Build the URLs that open a bridge in a viewer."""

from __future__ import annotations

import urllib.parse

#: URLs of the hosted applications Foxglove and Lichtblick, and the values of ``Origin`` that a
#: browser sends for their pages.
FOXGLOVE = 'https://app.foxglove.dev/~/view'
LICHTBLICK = 'https://lichtblick-suite.github.io/lichtblick/'
APPLICATIONS = ('https://app.foxglove.dev', 'https://lichtblick-suite.github.io')

def with_token(where: str, token: str, scheme: str = 'ws') -> str:
    """
    Return the URL of a bridge with its token.

    :param where: ``host:port``.
    :param scheme: 'wss' for the port that is open to other computers.
    """
    return f'{scheme}://{where}/?{urllib.parse.urlencode({"token": token})}'


def app(address: str, at: str = FOXGLOVE) -> str:
    """
    Return the URL that opens a bridge in a hosted web application.

    From a page of HTTPS, a browser opens ``ws://`` only to its own computer's loopback interface.

    :param address: URL of the bridge.
    :param at: URL of the application.
    """
    query = urllib.parse.urlencode({'ds': 'foxglove-websocket', 'ds.url': address})
    return f'{at}?{query}'


def served(where: str, token: str) -> str:
    """
    Return the URL at which the gate itself serves the web application.

    If the machine has no web application, the gate shows its page with links there.

    :param where: ``host:port``.
    """
    page = app(with_token(where, token), f'http://{where}/')
    return f'{page}&{urllib.parse.urlencode({"token": token})}'
