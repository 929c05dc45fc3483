# SPDX-License-Identifier: Apache-2.0
"""Parse the first request of a connection, and decide whether to admit it; pure."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import hmac
import http.cookies
import ipaddress
from typing import Optional
import urllib.parse

from fogros2_monitor import urls

#: Values of ``Origin`` that desktop applications send.
_DESKTOP = ('null', 'file://')


class Refused(Exception):
    """A refused request: the HTTP status, and the reason for the log."""

    def __init__(self, status: str, why: str) -> None:
        super().__init__(why)
        self.status = status


@dataclasses.dataclass(frozen=True)
class Request:
    """
    A GET request.

    :param target: path and query, without the token.
    :param given: the tokens in the query.
    :param host: header ``Host``.
    :param origins: headers ``Origin``: the sites whose pages sent the request.
    :param websocket: whether the request opens a WebSocket.
    :param version: HTTP version.
    :param lines: the lines of the header.
    """

    target: str
    given: tuple[str, ...]
    host: str
    origins: tuple[str, ...]
    websocket: bool
    version: str
    lines: tuple[str, ...]

    def handed_on(self, *, closing: bool = False) -> bytes:
        """
        Return the header of the request without the token, to forward it.

        :param closing: close the connection after the answer, and remove the query. The query
            tells the application's page in the browser the bridge's address and token.
        """
        target = self.target.partition('?')[0] if closing else self.target
        lines = [line for line in self.lines if not line.lower().startswith('cookie:')]
        if closing:
            lines = [line for line in lines if not line.lower().startswith('connection:')]
            lines.append('Connection: close')
        head = [f'GET {target} {self.version}', *lines, '', '']
        return '\r\n'.join(head).encode('latin-1')


def parse(head: bytes) -> Request:
    """
    Parse a request.

    :param head: the header, including its empty line.
    :raises Refused: the request is no GET of HTTP/1, or names several hosts.
    """
    line, *lines = head.decode('latin-1').split('\r\n')[:-2]
    words = line.split(' ')
    if len(words) != 3 or words[0] != 'GET' or not words[2].startswith('HTTP/1.'):
        raise Refused('400 Bad Request', 'what came is no request for a page or a WebSocket')
    try:
        url = urllib.parse.urlsplit(words[1])
        query = urllib.parse.parse_qsl(url.query, keep_blank_values=True)
    except ValueError as error:
        raise Refused('400 Bad Request', 'what came is no request for a page') from error
    hosts = _values(lines, 'host')
    if len(hosts) > 1:
        raise Refused('400 Bad Request', 'what came is for several hosts')
    tokens = tuple(value for name, value in query if name == 'token')
    path = url.path if url.path.startswith('/') else '/'
    rest = urllib.parse.urlencode([item for item in query if item[0] != 'token']) \
        if tokens else url.query
    # Only one slash: a redirect to '//x' would lead to the host x.
    return Request(
        '/' + path.lstrip('/\\') + (f'?{rest}' if rest else ''), tokens,
        ''.join(hosts), tuple(_values(lines, 'origin')),
        'websocket' in ','.join(_values(lines, 'upgrade')).lower(), words[2], tuple(lines))


def check_site(request: Request, name: str, *, encrypted: bool) -> None:
    """
    Check the site of a request, because any web page can make a browser send requests.

    Without TLS, ``Host`` must be an IP address, 'localhost' or the machine's name, which no
    attacker can point here (DNS rebinding). With TLS, the certificate protects the name.
    ``Origin`` may be missing or a desktop application's. Otherwise it must be the gate's own page,
    one of the linked applications, or a page of this computer.

    :param name: name of the machine.
    :raises Refused: the request comes from another site.
    """
    alone = _without_port(request.host)
    if not encrypted and not _is_address(alone) and alone not in ('localhost', name.lower()):
        raise Refused('421 Misdirected Request', 'asks for a host of another name')
    own = f'{"https" if encrypted else "http"}://{request.host}'
    for origin in request.origins:
        if origin not in (*_DESKTOP, *urls.APPLICATIONS, own) \
                and not is_loopback(origin.partition('://')[2]):
            raise Refused('403 Forbidden', "asks for another site's page")


def is_loopback(host: str) -> bool:
    """Return whether the value of a Host header names the loopback interface."""
    alone = _without_port(host)
    return alone == 'localhost' or _is_address(alone) and ipaddress.ip_address(alone).is_loopback


def _without_port(host: str) -> str:
    alone = host.rpartition(':')[0] if not host.endswith(']') and ':' in host else host
    return alone.strip('[]').lower()


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def cookie(token: str) -> tuple[str, str]:
    """
    Return name and value of the cookie that admits requests for pages.

    The value is not the token, because a browser sends a cookie to all ports of a host, on the
    loopback interface to any local server. For the same reason each gate has its own cookie name.
    """
    digest = hmac.new(token.encode(), b'pages', 'sha256').hexdigest()
    return f'fogros2-{digest[:8]}', digest[8:]


def check(request: Request, token: str) -> None:
    """
    Check the token of a request.

    A WebSocket needs the token in its URL. A cookie is not enough, because browsers add it to
    requests of other sites' pages too.

    :raises Refused: the token is missing or wrong.
    """
    name, value = cookie(token)
    secret = _cookie(_values(request.lines, 'cookie'), name)
    if request.given:
        right = len(request.given) == 1 and _same(request.given[0], token)
    elif secret and not request.websocket:
        right = _same(secret, value)
    else:
        raise Refused('401 Unauthorized', 'no token')
    if not right:
        raise Refused('401 Unauthorized', 'a wrong token')


def _same(secret: str, token: str) -> bool:
    return hmac.compare_digest(secret.encode('utf-8', 'replace'), token.encode())


def _values(lines: Sequence[str], name: str) -> list[str]:
    return [value.strip() for key, separator, value in (line.partition(':') for line in lines)
            if separator and key.lower() == name]


def _cookie(values: Sequence[str], name: str) -> str:
    morsel: Optional[http.cookies.Morsel[str]] = None
    for value in values:
        try:
            morsel = http.cookies.SimpleCookie(value).get(name, morsel)
        except http.cookies.CookieError:
            continue  # another site's cookie
    return morsel.value if morsel is not None else ''
