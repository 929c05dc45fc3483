# SPDX-License-Identifier: Apache-2.0
"""The first request on a connection: what it asks for, and whether it may; pure."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import hmac
import http.cookies
from typing import Optional
import urllib.parse

#: Name of the cookie that has the token, after the query had it.
COOKIE = 'fogros2'


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
    :param cookie: the token in a cookie, '' for none.
    :param host: whom it is for, in the words of who asks.
    :param websocket: whether it asks for a WebSocket.
    :param lines: the header, line by line.
    """

    target: str
    given: tuple[str, ...]
    cookie: str
    host: str
    websocket: bool
    version: str
    lines: tuple[str, ...]

    def handed_on(self, *, closing: bool = False) -> bytes:
        """
        Return the request's head without the token.

        :param closing: have the connection end with the answer.
        """
        left = [line for line in self.lines if not line.lower().startswith('cookie:')]
        if closing:
            left = [line for line in left if not line.lower().startswith('connection:')]
            left.append('Connection: close')
        head = [f'GET {self.target} {self.version}', *left, '', '']
        return '\r\n'.join(head).encode('latin-1')


def parse(head: bytes) -> Request:
    """
    Return what a request asks for.

    :param head: up to and with the empty line.
    :raises Refused: it isn't a GET of HTTP/1.
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
    given = tuple(value for name, value in query if name == 'token')
    path = url.path if url.path.startswith('/') else '/'
    left = urllib.parse.urlencode([item for item in query if item[0] != 'token']) \
        if given else url.query
    # one slash alone: '//x' would lead elsewhere where it is redirected to
    return Request(
        '/' + path.lstrip('/\\') + (f'?{left}' if left else ''), given,
        _cookie(_values(lines, 'cookie')), next(iter(_values(lines, 'host')), ''),
        'websocket' in ','.join(_values(lines, 'upgrade')).lower(), words[2], tuple(lines))


def check(request: Request, token: str) -> None:
    """
    Look for the token.

    A WebSocket has to have it in its address: a cookie comes along with what others' pages ask
    for, too.

    :raises Refused: it lacks, or is another.
    """
    if request.given:
        right = len(request.given) == 1 and _same(request.given[0], token)
    elif request.cookie and not request.websocket:
        right = _same(request.cookie, token)
    else:
        raise Refused('401 Unauthorized', 'no token')
    if not right:
        raise Refused('401 Unauthorized', 'a wrong token')


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode('utf-8', 'replace'), token.encode())


def _values(lines: Sequence[str], name: str) -> list[str]:
    return [value.strip() for key, separator, value in (line.partition(':') for line in lines)
            if separator and key.lower() == name]


def _cookie(values: Sequence[str]) -> str:
    found: Optional[http.cookies.Morsel[str]] = None
    for value in values:
        try:
            found = http.cookies.SimpleCookie(value).get(COOKIE, found)
        except http.cookies.CookieError:
            continue  # another's
    return found.value if found is not None else ''
