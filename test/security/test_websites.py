# SPDX-License-Identifier: Apache-2.0
"""
A page of any website, in the browser of somebody who may watch, attacks the bridge to Foxglove.

A browser opens WebSockets for every page, to every address that its computer reaches. Who gets in
may publish on every topic, so such a page could drive the robot.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import html
import os
from pathlib import Path
import re
import socket
import ssl
import subprocess
import sys
import threading
from types import SimpleNamespace
import urllib.parse

import pytest

from fogros2.waiting import wait_until
from fogros2_monitor import access, page, request, urls, verbs
from rigs.domains import taken
from ros2fog_cli.api import reach

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')

EVIL = 'https://evil.example'
#: Stands for a machine's address in the VPN.
VPN = '127.0.0.3'
#: As the kernel lists 127.0.0.1, ::1 and all addresses.
LOCALHOST = re.compile('(0100007F|0{24}01000000|0{8}|0{32}):')
DOORS = ['loopback', 'vpn', 'shared']
HANDSHAKE = (
    'GET {target} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n'
    'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n'
    'Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n{more}\r\n')


class Bridge:
    """A bridge with all three doors, as on a machine."""

    def __init__(
        self, process: subprocess.Popen[str], folder: Path, port: int, public: int,
    ) -> None:
        self.process = process
        self.places = {'loopback': ('127.0.0.1', port), 'vpn': (VPN, port),
                       'shared': ('127.0.0.1', public)}
        self.lines: list[str] = []
        self.reader = threading.Thread(target=lambda: self.lines.extend(process.stdout))
        self.reader.start()
        wait_until(lambda: self.text.count('listening on') == 3 and 'serving ws://' in self.text,
                   timeout=60, what='the bridge and its gate')
        self.token = (folder / 'token').read_text().strip()

    @property
    def text(self) -> str:
        return ''.join(self.lines)

    def open(self, door: str, *, token: bool = False, host: str = '', origin: str = '') -> int:
        """Return the status that answers the request for a WebSocket, 101 where it is open."""
        place = self.places[door]
        more = f'Origin: {origin}\r\n' if origin else ''
        return opened(place, HANDSHAKE.format(
            target=f'/?token={self.token}' if token else '/',
            host=host or '{}:{}'.format(*place), more=more), tls=door == 'shared')


def opened(place: tuple[str, int], request: str, *, tls: bool = False) -> int:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with socket.create_connection(place, timeout=60) as plain, \
            context.wrap_socket(plain) if tls else contextlib.nullcontext(plain) as connection:
        connection.sendall(request.encode())
        said = connection.recv(4096)
    return int(said.split()[1]) if said.startswith(b'HTTP/1.') else 0


@pytest.fixture(scope='module')
def domain() -> Iterator[str]:
    with taken() as domain:
        yield domain


@pytest.fixture(scope='module')
def bridge(tmp_path_factory: pytest.TempPathFactory, domain: str) -> Iterator[Bridge]:
    folder = tmp_path_factory.mktemp('secrets') / 'monitor' / 'launch'
    with socket.create_server(('127.0.0.1', 0)) as one, socket.create_server(('', 0)) as other:
        port, public = (probe.getsockname()[1] for probe in (one, other))
    process = subprocess.Popen(
        [sys.executable, '-m', 'fogros2_monitor.serve', '--name', 'planner',
         '--listen', f'127.0.0.1:{port}', '--vpn', str(port), '--public', str(public),
         '--secrets', str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, 'FOGROS2_VPN_ADDRESS': VPN, 'ROS_DOMAIN_ID': domain,
             'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'})
    running = None
    try:
        running = Bridge(process, folder, port, public)
        yield running
    finally:
        process.terminate()
        process.wait(60)
        if running is not None:
            running.reader.join(60)
        process.stdout.close()


def local_ports(pid: int) -> set[int]:
    """Return the TCP ports of localhost at which a process and its children listen."""
    tasks = [str(pid)]
    for task in tasks:
        tasks += Path(f'/proc/{task}/task/{task}/children').read_text().split()
    sockets = {os.readlink(link)[len('socket:['):-1] for task in tasks
               for link in Path(f'/proc/{task}/fd').iterdir()
               if os.readlink(link).startswith('socket:[')}
    rows = [line.split() for kind in ('tcp', 'tcp6')
            for line in Path('/proc/net', kind).read_text().splitlines()[1:]]
    return {int(row[1].partition(':')[2], 16) for row in rows
            if row[9] in sockets and row[3] == '0A' and LOCALHOST.match(row[1])}


@pytest.mark.parametrize('door', DOORS)
def test_only_an_application_with_the_token_gets_in(bridge, door):
    for origin in (EVIL, 'null', ''):
        assert bridge.open(door, origin=origin) in (401, 403), origin
    # a page that has read the token
    assert bridge.open(door, token=True, origin=EVIL) == 403
    for origin in ('', 'null', 'file://', 'https://app.foxglove.dev',
                   'https://lichtblick-suite.github.io'):
        assert bridge.open(door, token=True, origin=origin) == 101, origin


@pytest.mark.parametrize('door', ['loopback', 'vpn'])
@pytest.mark.parametrize('token', [False, True])
def test_name_that_was_led_to_the_bridge_does_not_get_in(bridge, door, token):
    """DNS rebinding: to the browser, the bridge is of the page's own site."""
    host = f'evil.example:{bridge.places[door][1]}'
    status = bridge.open(door, token=token, host=host, origin=f'http://{host}')
    assert status == 421, f'the {door} door let {host} in: {status}'


def test_no_port_of_localhost_lets_a_page_past_the_gate(bridge):
    """A page may try all 65,535 ports of a name it knows, and the bridge itself asks nobody."""
    ports = local_ports(bridge.process.pid)
    assert {port for _, port in bridge.places.values()} <= ports
    for port in ports:
        request = HANDSHAKE.format(
            target='/', host=f'localhost:{port}', more=f'Origin: {EVIL}\r\n')
        assert opened(('127.0.0.1', port), request) != 101, f'port {port} let a page in'


def test_log_has_no_token(bridge):
    bridge.open('loopback', token=True, origin=EVIL)
    bridge.open('shared', token=True)
    assert opened(bridge.places['shared'], HANDSHAKE.format(
        target='/?token=wrong', host='localhost', more=''), tls=True) == 401
    wait_until(lambda: 'turned away 127.0.0.1: a wrong token' in bridge.text,
               timeout=60, what='the refusal')
    assert bridge.token not in bridge.text


@pytest.mark.parametrize('encrypted', [True, False])
def test_no_link_to_another_site_has_the_token(
    encrypted: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    """The servers of a hosted application would get it in the address that a browser requests."""
    token, where = 'sesame-0123456789', '198.51.100.7:8766' if encrypted else 'localhost:8765'
    monkeypatch.setattr(reach, 'session', lambda entry: contextlib.nullcontext())
    monkeypatch.setattr(access, 'credentials_of', lambda *_: (where, token, 'AB:CD'))
    if encrypted:
        verbs.share(SimpleNamespace())  # type: ignore[arg-type]
    else:
        verbs.say('{}', where, token)
    asked = request.parse(f'GET /?token={token} HTTP/1.1\r\nHost: {where}\r\n\r\n'.encode())
    answer = page.links(asked, 'planner', token, encrypted=encrypted).decode()
    for text in (capsys.readouterr().out, html.unescape(answer)):
        found = re.findall(r'\w+://[^\s"\'<>]+', text)
        own = [url for url in found if urllib.parse.urlsplit(url).netloc == where]
        assert own and all(token in url for url in own)
        others = {url for url in found if url not in own}
        assert not any(token in url for url in others)
        assert others <= {urls.FOXGLOVE, urls.LICHTBLICK}
    assert b'Referrer-Policy: no-referrer' in page.links(
        asked, 'planner', token, encrypted=encrypted)
