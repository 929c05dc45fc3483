# SPDX-License-Identifier: Apache-2.0
"""
Build the gate's own answers: a page with links to the applications, and short refusals; pure.

The page has a second use. A browser refuses ``wss://`` with an unknown certificate without asking
the user. If the user opens this page over ``https://``, the browser asks.
"""

from __future__ import annotations

import html

from fogros2_monitor import urls
from fogros2_monitor.request import cookie, is_loopback, Request

#: Header that marks an answer as the gate's own, not the application's.
MARK = 'X-FogROS2-Gate'

_PAGE = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark">
<title>{name}</title>
<style>
body {{ font: 1rem/1.5 system-ui, sans-serif; max-width: 42rem; margin: 3rem auto;
padding: 0 1rem }}
code {{ overflow-wrap: anywhere }}
</style>
<h1>{name}</h1>
{text}
</html>
"""


def answer(status: str, body: str = '', *headers: str) -> bytes:
    """Return an HTTP answer that closes the connection; ``body`` is HTML."""
    data = body.encode()
    head = [
        f'HTTP/1.1 {status}', f'{MARK}: 1', 'Connection: close', f'Content-Length: {len(data)}',
        'Content-Type: text/html; charset=utf-8', 'Cache-Control: no-store',
        'Referrer-Policy: no-referrer', 'X-Content-Type-Options: nosniff',
        "Content-Security-Policy: default-src 'none'; style-src 'unsafe-inline'", *headers, '', '']
    return '\r\n'.join(head).encode('latin-1') + data


def refusal(status: str, name: str) -> bytes:
    """
    Return the answer to a refused request.

    :param name: name of the machine.
    """
    return answer(status, _PAGE.format(name=html.escape(name), text=(
        '<p>The address with its token is printed by</p>'
        f'<p><code>ros2 fog monitor {html.escape(name)}</code></p>')
        if status.startswith('401') else f'<p>{html.escape(status)}</p>'))


def redirect(request: Request, token: str, *, encrypted: bool) -> bytes:
    """Return a redirect to the same page without the token; a cookie admits its resources."""
    return answer(
        '303 See Other', '', f'Location: {request.target}',
        f'Set-Cookie: {"=".join(cookie(token))}; Path=/; HttpOnly; SameSite=Lax'
        + ('; Secure' if encrypted else ''))


def links(request: Request, name: str, token: str, *, encrypted: bool) -> bytes:
    """
    Return the page with links to the web applications.

    :param name: name of the machine.
    :param encrypted: whether the request came over TLS.
    """
    # The requested host is the one address that is known to work from the browser.
    where = request.host
    address = urls.with_token(where, token, 'wss' if encrypted else 'ws')
    parts = [f'<p>The topics of this machine are at<br><code>{html.escape(address)}</code></p>']
    if encrypted:
        parts.append('<p>The certificate is accepted: your browser will open this address in the '
                     'applications below, too.</p>')
    if encrypted or is_loopback(where):
        parts.append(
            f'<p>In <a href="{urls.LICHTBLICK}">Lichtblick</a> or <a href="{urls.FOXGLOVE}">'
            f'Foxglove</a>, choose {html.escape(urls.HOW)}. The application then has the token.'
            '</p>')
    else:
        parts.append(
            '<p>Pages of other hosts may not open it from here, as the connection to this one is '
            'not encrypted by the browser. Take the desktop application, or</p>'
            f'<p><code>ros2 fog monitor {html.escape(name)}</code></p>')
    return answer('200 OK', _PAGE.format(name=html.escape(name), text='\n'.join(parts)))
