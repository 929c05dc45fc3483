# SPDX-License-Identifier: Apache-2.0
"""
What stands before the bridge: it listens where the bridge doesn't, and lets in who may.

The bridge itself listens on loopback. The gate takes connections on the VPN's address and hands
them on as they are; where others than the robot were allowed in, it takes theirs on a port of its
own, over TLS, and hands on those alone whose request carries the token:
``wss://ADDRESS:PORT/?token=TOKEN``. All else is turned away, and logged once per address and
cause, so that nobody fills the disk by knocking.

Standard library only: it also stands before ROS 2's own ``foxglove_bridge``, on machines that have
nothing else of this package.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Sequence
import contextlib
import hmac
import os
import signal
import socket
import ssl
import sys
from typing import Optional
import urllib.parse

#: Variable of all nodes on a machine: its address in the VPN.
VPN_ADDRESS = 'FOGROS2_VPN_ADDRESS'
#: Bytes and seconds that a request may take until its empty line.
HEAD, HEAD_TIME = 16384, 10.0
#: Seconds for the handshake of TLS.
HANDSHAKE = 10.0
#: Connections at once; a browser that watches takes one.
CONNECTIONS = 200
#: Addresses and causes remembered as logged.
LOGGED = 1000
_BLOCK = 65536


class Refused(Exception):
    """A request that isn't let in: the status to answer, and why, for the log."""

    def __init__(self, status: str, why: str) -> None:
        super().__init__(why)
        self.status = status


def admitted(head: bytes, token: str) -> bytes:
    """
    Return a request's head without the token, to be handed on.

    :param head: the request, up to and with the empty line.
    :raises Refused: it isn't a GET, or lacks the token, or has a wrong one.
    """
    line, separator, rest = head.partition(b'\r\n')
    words = line.split(b' ')
    if len(words) != 3 or words[0] != b'GET' or not separator:
        raise Refused('400 Bad Request', 'what came is no request for a WebSocket')
    url = urllib.parse.urlsplit(words[1].decode('latin-1'))
    query = urllib.parse.parse_qsl(url.query, keep_blank_values=True)
    given = [value for name, value in query if name == 'token']
    if not given:
        raise Refused('401 Unauthorized', 'no token')
    if len(given) > 1 or not hmac.compare_digest(given[0].encode(), token.encode()):
        raise Refused('401 Unauthorized', 'a wrong token')
    left = urllib.parse.urlencode([item for item in query if item[0] != 'token'])
    target = urllib.parse.urlunsplit(('', '', url.path or '/', left, ''))
    return b'GET ' + target.encode('latin-1') + b' ' + words[2] + separator + rest


class Gate:
    """
    Hands connections on.

    :param to: address and port of the bridge.
    :param token: what requests have to carry where one is asked for.
    """

    def __init__(self, to: tuple[str, int], token: str = '') -> None:
        self._to = to
        self._token = token
        self._logged: set[tuple[str, str]] = set()
        self._connections: set[asyncio.Task[None]] = set()

    async def serve(self, listener: socket.socket, tls: Optional[ssl.SSLContext] = None) -> None:
        """
        Take connections until cancelled.

        :param listener: a socket that listens, and doesn't block.
        :param tls: asks for TLS and the token; without it, whoever gets here may come in.
        """
        loop = asyncio.get_running_loop()
        try:
            while True:
                connection, peer = await loop.sock_accept(listener)
                if len(self._connections) >= CONNECTIONS:
                    self._turn_away(peer[0], f'{CONNECTIONS} connections are open')
                    connection.close()
                    continue
                task = loop.create_task(self._greet(connection, peer[0], tls))
                self._connections.add(task)
                task.add_done_callback(self._connections.discard)
        finally:
            listener.close()

    async def _greet(
        self, connection: socket.socket, peer: str, tls: Optional[ssl.SSLContext],
    ) -> None:
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=HEAD, loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        try:
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, connection, ssl=tls,
                ssl_handshake_timeout=HANDSHAKE if tls else None)
        except OSError as error:  # of TLS, too
            self._turn_away(peer, f'no TLS: {getattr(error, "reason", "") or error}')
            connection.close()
            return
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        try:
            head = admitted(await _head(reader), self._token) if tls else b''
            await self._pass(reader, writer, head)
        except Refused as refused:
            self._turn_away(peer, str(refused))
            if tls:
                writer.write(f'HTTP/1.1 {refused.status}\r\nContent-Length: 0\r\n'
                             'Connection: close\r\n\r\n'.encode())
        except (OSError, asyncio.IncompleteReadError):
            pass  # gone before it said what it wants
        finally:
            await _closed(writer)

    async def _pass(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, head: bytes,
    ) -> None:
        """Carry bytes both ways until either side ends."""
        try:
            inner_reader, inner_writer = await asyncio.open_connection(*self._to)
        except OSError as error:
            raise Refused('502 Bad Gateway', f'the bridge does not answer: {error}') from error
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

    def _turn_away(self, who: str, why: str) -> None:
        if (who, why) not in self._logged and len(self._logged) < LOGGED:
            self._logged.add((who, why))
            print(f'turned away {who}: {why}', file=sys.stderr, flush=True)


async def _head(reader: asyncio.StreamReader) -> bytes:
    try:
        return await asyncio.wait_for(reader.readuntil(b'\r\n\r\n'), HEAD_TIME)
    except asyncio.LimitOverrunError:
        raise Refused('431 Request Header Fields Too Large', 'too long a request') from None
    except asyncio.TimeoutError:
        raise Refused('408 Request Timeout', 'no whole request in time') from None


async def _carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    # drain() waits for a slow viewer: then the bridge's own queue for it fills, and drops
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
    Return address and port of ``ADDRESS:PORT``; an IPv6 address stands in brackets.

    :raises argparse.ArgumentTypeError: it isn't of this form.
    """
    host, separator, port = text.rpartition(':')
    if not separator or not port.isdigit() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"'{text}' isn't ADDRESS:PORT")
    return host.strip('[]'), int(port)


def _listen(address: tuple[str, int]) -> socket.socket:
    listener = socket.create_server(
        address, family=socket.AF_INET6 if ':' in address[0] else socket.AF_INET)
    listener.setblocking(False)
    print('listening on {}:{}'.format(*listener.getsockname()), flush=True)
    return listener


async def _run(options: argparse.Namespace) -> None:
    ended = asyncio.ensure_future(asyncio.Event().wait())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.cancel)
    if options.until_eof:
        loop.add_reader(0, ended.cancel)  # nothing is ever written there
    token, tls = '', None
    if options.guarded:
        with open(options.token_file, encoding='ascii') as file:
            token = file.read().strip()
        if not token:
            raise SystemExit(f'gate: {options.token_file} holds no token')
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.minimum_version = ssl.TLSVersion.TLSv1_2
        tls.load_cert_chain(options.certificate, options.key)
    gate = Gate(options.to, token)
    serving = [asyncio.ensure_future(gate.serve(_listen(address))) for address in options.listen]
    if options.guarded:
        serving.append(asyncio.ensure_future(gate.serve(_listen(options.guarded), tls)))
    await asyncio.wait({ended, *serving}, return_when=asyncio.FIRST_COMPLETED)
    for task in serving:
        if task.done():
            task.result()  # listening ends with an error alone


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """Run until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--to', type=endpoint, required=True, help='where the bridge listens')
    parser.add_argument('--listen', type=endpoint, action='append', default=[],
                        help='where to listen for whoever gets there')
    parser.add_argument('--vpn', type=int, metavar='PORT', help=f'the same, at ${VPN_ADDRESS}')
    parser.add_argument('--until-eof', action='store_true',
                        help='end with the process that has the other end of the input')
    parser.add_argument('--guarded', type=endpoint, help='where to listen with TLS and a token')
    parser.add_argument('--certificate', help='PEM file')
    parser.add_argument('--key', help='PEM file')
    parser.add_argument('--token-file', help='file with the token, so that no process list has it')
    options = parser.parse_args(arguments)
    if options.vpn is not None:
        if VPN_ADDRESS not in os.environ:
            parser.error(f'--vpn takes {VPN_ADDRESS}, which nodes on a machine have')
        options.listen.append((os.environ[VPN_ADDRESS], options.vpn))
    if options.guarded and not (options.certificate and options.key and options.token_file):
        parser.error('--guarded takes --certificate, --key and --token-file')
    asyncio.run(_run(options))


if __name__ == '__main__':
    main()
