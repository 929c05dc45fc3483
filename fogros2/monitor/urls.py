# SPDX-License-Identifier: Apache-2.0
"""Where a browser sees what a bridge serves."""

from __future__ import annotations

import urllib.parse

#: Port on which viewers expect a bridge.
PORT = 8765
_APP = 'https://app.foxglove.dev/~/view'


def bridge(host: str, port: int) -> str:
    """Return a bridge's own address, for the desktop application."""
    return f'ws://[{host}]:{port}' if ':' in host else f'ws://{host}:{port}'


def app(address: str, at: str = _APP) -> str:
    """
    Return a web application's address that opens a bridge.

    A page that came over HTTPS may open ``ws://`` on this computer's loopback alone.

    :param address: the bridge's.
    :param at: the application's; Lichtblick takes the same.
    """
    query = urllib.parse.urlencode({'ds': 'foxglove-websocket', 'ds.url': address})
    return f'{at}?{query}'
