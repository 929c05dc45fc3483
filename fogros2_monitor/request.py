# SPDX-License-Identifier: Apache-2.0
"""The first request on a connection: what it asks for, and whether it may; pure."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import hmac
import http.cookies
import ipaddress
from typing import Optional
import urllib.parse

from fogros2_monitor import urls

#: What desktop applications say in ``Origin``, where they say anything.
_DESKTOP = ('null', 'file://')


class Refused(Exception):
    """A request that isn't let in: the status to answer, and why, for the log."""

    def __init__(self, status: str, why: str) -> None:
        super().__init__(why)
        self.status = status


@dataclasses.dataclass(frozen=True)
class Request:
    """
    A GET.

    :param target: path and query, without the token.
    :param given: the tokens in the query.
    :param host: whom it is for, in the words of who asks.
    :param origins: the sites whose pages ask, in a browser's words.
    :param websocket: whether it asks for a WebSocket.
    :param lines: the header, line by line.
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
        Return the request's head without the token.

        :param closing: have the connection end with the answer, and leave the query out: it tells
            the application's page, in the browser, of the bridge and its token.
        """
        target = self.target.partition('?')[0] if closing else self.target
        left = [line for line in self.lines if not line.lower().startswith('cookie:')]
        if closing:
            left = [line for line in left if not line.lower().startswith('connection:')]
            left.append('Connection: close')
        head = [f'GET {target} {self.version}', *left, '', '']
        return '\r\n'.join(head).encode('latin-1')


def parse(head: bytes) -> Request:
    """
    Return what a request asks for.

    :param head: up to and with the empty line.
    :raises Refused: it isn't a GET of HTTP/1, or is for several hosts.
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
    given = tuple(value for name, value in query if name == 'token')
    path = url.path if url.path.startswith('/') else '/'
    left = urllib.parse.urlencode([item for item in query if item[0] != 'token']) \
        if given else url.query
    # one slash alone: '//x' would lead elsewhere where it is redirected to
    return Request(
        '/' + path.lstrip('/\\') + (f'?{left}' if left else ''), given,
        ''.join(hosts), tuple(_values(lines, 'origin')),
        'websocket' in ','.join(_values(lines, 'upgrade')).lower(), words[2], tuple(lines))


def check_site(request: Request, name: str, *, encrypted: bool) -> None:
    """
    Look at the site whose page asks: a browser that may come in asks for any page it shows.

    ``Host`` has to be an address, or a name that nobody else can lead here (DNS rebinding); over
    TLS the certificate stands for the name. ``Origin`` is missing, as desktop applications have
    it, or the gate's own page, one of the applications that we lead to, or of this computer's.

    :param name: the machine's.
    :raises Refused: it is another site's.
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
    """Return whether a Host header's value names the loopback."""
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
    Return name and value of the cookie that gets pages, after the query had the token.

    The value isn't the token: a browser shows it to all ports of a host, so on the loopback to
    whatever listens there. Each gate has a name of its own, for the same reason.
    """
    digest = hmac.new(token.encode(), b'pages', 'sha256').hexdigest()
    return f'fogros2-{digest[:8]}', digest[8:]


def check(request: Request, token: str) -> None:
    """
    Look for the token.

    A WebSocket has to have it in its address: a cookie comes along with what others' pages ask
    for, too.

    :raises Refused: it lacks, or is another.
    """
    name, value = cookie(token)
    given = _cookie(_values(request.lines, 'cookie'), name)
    if request.given:
        right = len(request.given) == 1 and _same(request.given[0], token)
    elif given and not request.websocket:
        right = _same(given, value)
    else:
        raise Refused('401 Unauthorized', 'no token')
    if not right:
        raise Refused('401 Unauthorized', 'a wrong token')


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode('utf-8', 'replace'), token.encode())


def _values(lines: Sequence[str], name: str) -> list[str]:
    return [value.strip() for key, separator, value in (line.partition(':') for line in lines)
            if separator and key.lower() == name]


def _cookie(values: Sequence[str], name: str) -> str:
    found: Optional[http.cookies.Morsel[str]] = None
    for value in values:
        try:
            found = http.cookies.SimpleCookie(value).get(name, found)
        except http.cookies.CookieError:
            continue  # another's
    return found.value if found is not None else ''
