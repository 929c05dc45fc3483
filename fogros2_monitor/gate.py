# SPDX-License-Identifier: Apache-2.0
"""
Protect the bridge: listen on the network, and admit only requests that have the token.

The bridge itself has no authentication, and any web page can make the user's browser connect to
it. So the gate forwards only requests that carry the token (``ws://ADDRESS:PORT/?token=TOKEN``)
and that no page of another site made. It listens on the loopback interface and on the machine's
VPN address. On request it also opens a port of its own to other computers, over TLS and only from
the given networks. The gate refuses all other requests. It logs a refusal once per address and
reason, so that refused clients cannot fill the disk.

The gate forwards a request for a page to the web application if the machine has one. Otherwise
its own page links to hosted applications.

The gate uses only the standard library, so that it starts at once.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Sequence
import contextlib
import dataclasses
import ipaddress
import os
import signal
import socket
import ssl
import sys
from typing import Optional, Union

from fogros2_monitor import accounts, page
from fogros2_monitor.request import check, check_site, parse, Refused, Request

#: Environment variable of all nodes on a machine: its VPN address.
VPN_ADDRESS = 'FOGROS2_VPN_ADDRESS'
#: Largest header of a request in bytes, and its time-out in seconds.
HEAD, HEAD_TIME = 16384, 10.0
#: Time-out of the TLS handshake in seconds.
HANDSHAKE = 10.0
#: Maximum connections of each listening socket, so that outside clients cannot use up those of
#: the robot. A viewer in a browser uses one.
CONNECTIONS = 100
#: Number of different refusals to log.
LOGGED = 1000
#: Bytes to copy at once; large, so that an image takes few iterations.
_BLOCK = 1 << 18

Network = Union[ipaddress.IPv4Network, ipaddress.IPv6Network]


@dataclasses.dataclass(frozen=True)
class PublicPort:
    """
    TLS and allowed networks of a port that is open to other computers than the robot.

    :param allowed: networks that may connect; empty: all networks.
    """

    tls: ssl.SSLContext
    allowed: tuple[Network, ...] = ()

    def allows(self, peer: str) -> bool:
        """Return whether an address is in an allowed network."""
        address = ipaddress.ip_address(peer)
        return not self.allowed or any(address in network for network in self.allowed)


class Gate:
    """
    Forward admitted connections.

    :param to: address and port of the bridge.
    :param token: the required token.
    :param application: address and port of the web application, None if there is none.
    :param name: name of the machine.
    """

    def __init__(
        self, to: tuple[str, int], token: str, application: Optional[tuple[str, int]] = None,
        name: str = '',
    ) -> None:
        self._to = to
        self._token = token
        self._application = application
        self._name = name
        self._logged: set[tuple[str, str]] = set()

    async def serve(self, listener: socket.socket, public: Optional[PublicPort] = None) -> None:
        """
        Accept connections until cancelled.

        :param listener: a listening, non-blocking socket.
        :param public: for a port that is open to other computers than the robot.
        """
        loop = asyncio.get_running_loop()
        connections: set[asyncio.Task[None]] = set()
        try:
            while True:
                connection, peer = await loop.sock_accept(listener)
                who = accounts.plain_address(peer[0])
                why = '' if len(connections) < CONNECTIONS else \
                    f'{CONNECTIONS} connections are open'
                if public is None and accounts.is_foreign(connection):
                    why = 'from another account of this computer'
                if public is not None and not public.allows(who):
                    why = 'not among the networks that are allowed'
                if why:
                    self._turn_away(who, why)
                    connection.close()
                    continue
                task = loop.create_task(self._greet(connection, who, public))
                connections.add(task)
                task.add_done_callback(connections.discard)
        finally:
            listener.close()

    async def _greet(
        self, connection: socket.socket, peer: str, public: Optional[PublicPort],
    ) -> None:
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=HEAD, loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        try:
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, connection, ssl=public.tls if public else None,
                ssl_handshake_timeout=HANDSHAKE if public else None)
        except OSError as error:  # includes errors of TLS
            self._turn_away(peer, f'no TLS: {getattr(error, "reason", "") or error}')
            connection.close()
            return
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        try:
            request = parse(await _head(reader))
            check_site(request, self._name, encrypted=public is not None)
            check(request, self._token)
            await self._lead(request, reader, writer, encrypted=public is not None)
        except Refused as refused:
            self._turn_away(peer, str(refused))
            writer.write(page.refusal(refused.status, self._name))
        except (OSError, asyncio.IncompleteReadError):
            pass  # the client disconnected before it sent a request
        finally:
            await _closed(writer)

    async def _lead(
        self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter,
        *, encrypted: bool,
    ) -> None:
        """Forward a request to the bridge or the web application, or answer it."""
        if request.websocket:
            try:
                inner = await _connect(self._to)
            except OSError as error:
                raise Refused(
                    '502 Bad Gateway', f'the bridge does not answer: {error}') from error
            await _pass(request.handed_on(), reader, writer, *inner)
            return
        try:
            if self._application is None:
                raise ConnectionRefusedError
            inner = await _connect(self._application)
        except OSError:
            # Browsers request the icon by themselves; it gets no page.
            writer.write(page.answer('404 Not Found') if request.target == '/favicon.ico'
                         else page.links(request, self._name, self._token,
                                         encrypted=encrypted))
            return
        if request.given:
            writer.write(page.redirect(request, self._token, encrypted=encrypted))
            await _closed(inner[1])
            return
        # One request per connection, because the next one may be for the bridge.
        await _pass(request.handed_on(closing=True), reader, writer, *inner)

    def _turn_away(self, who: str, why: str) -> None:
        if (who, why) not in self._logged and len(self._logged) < LOGGED:
            self._logged.add((who, why))
            print(f'turned away {who}: {why}', file=sys.stderr, flush=True)


async def _connect(to: tuple[str, int]) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """
    Connect to a server of this account.

    :raises OSError: there is none.
    """
    reader, writer = await asyncio.open_connection(*to, limit=_BLOCK)
    if accounts.is_strangers(writer.get_extra_info('socket')):
        writer.close()
        raise PermissionError('another account listens there')
    return reader, writer


async def _pass(
    head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter,
    inner_reader: asyncio.StreamReader, inner_writer: asyncio.StreamWriter,
) -> None:
    """Copy bytes in both directions until one side closes the connection."""
    inner_writer.write(head)
    ways = {asyncio.ensure_future(_carry(reader, inner_writer)),
            asyncio.ensure_future(_carry(inner_reader, writer))}
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)
        await _closed(inner_writer)


async def _head(reader: asyncio.StreamReader) -> bytes:
    try:
        first = await asyncio.wait_for(reader.read(1), HEAD_TIME)
    except asyncio.TimeoutError:
        # Browsers open connections in advance.
        raise ConnectionAbortedError from None
    try:
        return first + await asyncio.wait_for(reader.readuntil(b'\r\n\r\n'), HEAD_TIME)
    except asyncio.LimitOverrunError:
        raise Refused('431 Request Header Fields Too Large', 'too long a request') from None
    except asyncio.TimeoutError:
        raise Refused('408 Request Timeout', 'no whole request in time') from None


async def _carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    # drain() waits for a slow viewer, so the bridge's queue for it fills, and drops messages.
    with contextlib.suppress(OSError):
        while block := await reader.read(_BLOCK):
            writer.write(block)
            await writer.drain()


async def _closed(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with contextlib.suppress(OSError, asyncio.TimeoutError):
        await asyncio.wait_for(writer.wait_closed(), HANDSHAKE)


def endpoint(text: str) -> tuple[str, int]:
    """
    Return address and port of ``ADDRESS:PORT``; an IPv6 address is in brackets.

    :raises argparse.ArgumentTypeError: the text has another form.
    """
    host, separator, port = text.rpartition(':')
    if not separator or not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"'{text}' isn't ADDRESS:PORT")
    return host.strip('[]'), int(port)


def _listen(address: tuple[str, int]) -> socket.socket:
    """
    Listen at an address; '' is every address of the machine.

    :raises SystemExit: another program has the port, or the machine lacks the address.
    """
    host, port = address
    try:
        listener = _server(host, port)
    except OSError as error:
        raise SystemExit(
            f'gate: nobody can listen at {host}:{port}: {os.strerror(error.errno or 0)}\n'
            'Foxglove(port=) chooses another port') from error
    listener.setblocking(False)
    print('listening on {}:{}'.format(*listener.getsockname()), flush=True)
    return listener


def _server(host: str, port: int) -> socket.socket:
    if host == '':  # all addresses of the machine
        both = socket.has_dualstack_ipv6()
        return socket.create_server(
            ('', port), family=socket.AF_INET6 if both else socket.AF_INET, dualstack_ipv6=both)
    return socket.create_server(
        (host, port), family=socket.AF_INET6 if ':' in host else socket.AF_INET)


async def _run(options: argparse.Namespace) -> None:
    ended = asyncio.ensure_future(asyncio.Event().wait())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        # the bridge, which gets the signal too, fails if its gate ends first
        loop.add_signal_handler(number, int if options.until_eof else ended.cancel)
    if options.until_eof:
        loop.add_reader(0, ended.cancel)  # the parent never writes: readable means closed
    gate = Gate(options.to, _token(options.token_file), options.application, options.name)
    serving = [asyncio.ensure_future(gate.serve(_listen(address))) for address in options.listen]
    if options.public:
        serving.append(asyncio.ensure_future(
            gate.serve(_listen(options.public), _public_port(options))))
    if options.ready is not None:
        os.write(options.ready, b'\n')
    await asyncio.wait({ended, *serving}, return_when=asyncio.FIRST_COMPLETED)
    for task in serving:
        if task.done():
            task.result()  # a task ends only with an error


def _token(path: str) -> str:
    with open(path, encoding='ascii') as file:
        token = file.read().strip()
    if not token:
        raise SystemExit(f'gate: {path} holds no token')
    return token


def _public_port(options: argparse.Namespace) -> PublicPort:
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.minimum_version = ssl.TLSVersion.TLSv1_2
    tls.load_cert_chain(options.certificate, options.key)
    return PublicPort(tls, tuple(options.allow))


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """Run the gate until a signal."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--to', type=endpoint, required=True, help='where the bridge listens')
    parser.add_argument('--listen', type=endpoint, action='append', default=[],
                        help='where to listen without TLS')
    parser.add_argument('--vpn', type=int, metavar='PORT', help=f'the same, at ${VPN_ADDRESS}')
    parser.add_argument('--until-eof', action='store_true',
                        help='end with the process that has the other end of the input')
    parser.add_argument('--public', type=endpoint,
                        help='where to listen with TLS; :PORT for every address')
    parser.add_argument('--allow', type=ipaddress.ip_network, action='append', default=[],
                        help='network (CIDR) that may knock there; all unless given')
    parser.add_argument('--certificate', help='PEM file')
    parser.add_argument('--key', help='PEM file')
    parser.add_argument('--token-file', required=True,
                        help='file with the token, so that no process list has it')
    parser.add_argument('--ready', type=int,
                        help='file descriptor that gets a byte when the gate listens')
    parser.add_argument('--application', type=endpoint, help='where the web application listens')
    parser.add_argument('--name', default=socket.gethostname(), help="the machine's, for people")
    options = parser.parse_args(arguments)
    if options.vpn is not None:
        options.listen.append((os.environ[VPN_ADDRESS], options.vpn))
    asyncio.run(_run(options))


if __name__ == '__main__':
    main()
