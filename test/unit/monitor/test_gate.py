# SPDX-License-Identifier: Apache-2.0
"""The gate before the bridge: who gets through, who doesn't, and what is said of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
import os
from pathlib import Path
import queue
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading

import pytest

from fogros2_monitor import accounts, addresses, credentials, page
from fogros2_monitor.gate import endpoint
from fogros2_monitor.request import check, check_site, cookie, parse, Refused

TOKEN = 'sesame-0123456789'


def request(target: str, method: str = 'GET', more: str = '') -> bytes:
    return f'{method} {target} HTTP/1.1\r\nHost: x\r\n{more}\r\n'.encode()


def test_token_is_removed_from_forwarded_requests():
    for target, left in ((f'/a?x=1&token={TOKEN}&y=%20', '/a?x=1&y=+'),
                         (f'/?token={TOKEN}', '/'), ('/a?x=%20', '/a?x=%20')):
        assert parse(request(target)).handed_on() == request(left)
    more = f'Cookie: a=b; fogros2={TOKEN}\r\nConnection: keep-alive\r\n'
    assert parse(request('/a?ds.url=x', more=more)).handed_on(closing=True) == request(
        '/a', more='Connection: close\r\n')


def test_cookie_admits_pages_but_no_websocket():
    name, value = cookie(TOKEN)
    more = f'Cookie: a=b; {name}={value}\r\n'
    check(parse(request('/', more=more)), TOKEN)
    with pytest.raises(Refused, match='no token'):
        check(parse(request('/', more=f'{more}Upgrade: WebSocket\r\n')), TOKEN)
    with pytest.raises(Refused, match='a wrong token'):
        check(parse(request('/', more=f'Cookie: {name}=x\r\n')), TOKEN)
    with pytest.raises(Refused, match='no token'):
        check(parse(request('/', more='Cookie: ;;=\r\n')), TOKEN)


@pytest.mark.parametrize('target', ['//evil.example/x', '/\\evil.example/x', 'http://x//evil'])
def test_redirect_stays_on_the_host(target):
    answer = page.redirect(
        parse(request(f'{target}?token={TOKEN}')), TOKEN, encrypted=True)
    place, = (line for line in answer.split(b'\r\n') if line.startswith(b'Location: '))
    assert place[len('Location: '):][:2] not in (b'//', b'/\\')
    assert TOKEN.encode() not in answer
    assert f'={cookie(TOKEN)[1]}; Path=/; HttpOnly; SameSite=Lax; Secure'.encode() in answer


@pytest.mark.parametrize(('host', 'origin'), [
    ('localhost:8765', None), ('127.0.0.1:8765', 'null'), ('[::1]:8765', 'file://'),
    ('198.18.1.2:8765', 'http://198.18.1.2:8765'), ('Planner:8765', 'https://app.foxglove.dev'),
    ('198.18.1.2', 'https://lichtblick-suite.github.io'),
    ('198.18.1.2:8765', 'http://localhost:8080'), ('198.18.1.2:8765', 'http://[::1]:8080'),
])
def test_linked_applications_are_admitted(host, origin):
    more = '' if origin is None else f'Origin: {origin}\r\n'
    head = f'GET / HTTP/1.1\r\nHost: {host}\r\n{more}\r\n'.encode()
    check_site(parse(head), 'planner', encrypted=False)


@pytest.mark.parametrize(('host', 'origins', 'status'), [
    ('localhost:8765', ['https://evil.example'], '403'),
    ('localhost:8765', ['http://localhost.evil.example'], '403'),
    ('localhost:8765', ['http://127.0.0.1.evil.example:8765'], '403'),
    ('localhost:8765', ['https://app.foxglove.dev.evil.example'], '403'),
    ('localhost:8765', ['http://evil@localhost'], '403'),
    ('localhost:8765', ['null', 'https://evil.example'], '403'),
    ('localhost:8765', ['http://198.18.1.2:8765'], '403'),
    ('localhost:8765', [''], '403'),
    ('evil.example:8765', ['http://evil.example:8765'], '421'),
    ('evil.example:8765', [], '421'), ('', [], '421'),
    ('localhost.evil.example', [], '421'), ('127.0.0.1.evil.example', [], '421'),
    ('localhost\r\nHost: evil.example', [], '400'),
])
def test_other_sites_are_refused(host, origins, status):
    more = ''.join(f'Origin: {origin}\r\n' for origin in origins)
    with pytest.raises(Refused) as refused:
        check_site(parse(f'GET / HTTP/1.1\r\nHost: {host}\r\n{more}\r\n'.encode()), 'planner',
                   encrypted=False)
    assert refused.value.status.startswith(status)
    assert 'evil' not in str(refused.value), 'the log takes no words of a stranger'


def test_host_name_is_free_over_tls():
    """A cluster's load balancer has a name that the machine doesn't know."""
    head = 'GET / HTTP/1.1\r\nHost: lb.example:8766\r\nOrigin: {}\r\n\r\n'
    check_site(parse(head.format('https://lb.example:8766').encode()), 'm', encrypted=True)
    for other in ('https://evil.example', 'http://lb.example:8766'):
        with pytest.raises(Refused, match='another site'):
            check_site(parse(head.format(other).encode()), 'm', encrypted=True)


@pytest.mark.parametrize(('head', 'status'), [
    (request('/'), '401'),
    (request('/?token='), '401'),
    (request('/?token=wrong'), '401'),
    (request(f'/?token=wrong&token={TOKEN}'), '401'),
    (request(f'/?token={TOKEN}x'), '401'),
    (request('/?token=%ff%00'), '401'),
    (request(f'/?token={TOKEN}', 'POST'), '400'),
    (b'\x16\x03\x01 nonsense\r\n\r\n', '400'),
    (b'\r\n\r\n', '400'),
    (b'GET / HTTP/2\r\n\r\n', '400'),
    (b'GET //[x HTTP/1.1\r\n\r\n', '400'),
])
def test_requests_without_the_token_are_refused(head, status):
    with pytest.raises(Refused) as refused:
        check(parse(head), TOKEN)
    assert refused.value.status.startswith(status)
    assert TOKEN not in str(refused.value)


def test_endpoint_is_an_address_and_a_port():
    assert endpoint('198.18.0.1:8765') == ('198.18.0.1', 8765)
    assert endpoint('[::1]:0') == ('::1', 0)
    for text in ('8765', 'here:', 'here:x', 'here:70000'):
        with pytest.raises(Exception, match='ADDRESS:PORT'):
            endpoint(text)


def test_ipv4_address_is_the_same_on_an_ipv6_socket():
    assert accounts.plain_address('::ffff:198.51.100.1') == '198.51.100.1'
    assert accounts.plain_address('fe80::1%eth0') == 'fe80::1'


@pytest.mark.parametrize(('host', 'links', 'shown'), [
    ('localhost:8765', True, 'ws://localhost:8765'),
    ('127.0.0.1:1', True, 'ws://127.0.0.1:1'),
    ('[::1]:1', True, 'ws://[::1]:1'),
    ('198.18.0.1:8765', False, 'ws://198.18.0.1:8765'),
    ('"><script>', False, 'ws://&quot;&gt;&lt;script&gt;'),
])
def test_page_links_applications_that_can_open_the_bridge(host, links, shown):
    asked = parse(f'GET / HTTP/1.1\r\nHost: {host}\r\n\r\n'.encode())
    text = page.links(asked, 'planner', TOKEN, encrypted=False).decode()
    assert (f'{shown}/?token={TOKEN}' in text, 'https://' in text) == (True, links)
    assert '<script>' not in text


class Running:
    """A gate in a process of its own."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        made = credentials.Credentials(folder)
        self.token = made.token.read_text().strip()
        self.certificate = made.certificate
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, args=(process,))
        self._reader.start()
        self.ports = [int(re.fullmatch(r'listening on .*:(\d+)', self.line())[1])
                      for _ in range(2)]

    def _read(self, process):
        for line in process.stdout:
            self._lines.put(line.strip())

    def line(self) -> str:
        return self._lines.get(timeout=20)

    def ended(self) -> list[str]:
        self._reader.join(60)
        return list(self._lines.queue)


@contextmanager
def running(folder: Path, to: int, *words: str) -> Iterator[Running]:
    if shutil.which('openssl') is None:
        pytest.skip('needs openssl')
    folder = Path(addresses.folder_of(str(folder), 8765, 'launch'))
    made = credentials.make(folder, 'planner')
    process = subprocess.Popen(
        [sys.executable, '-m', 'fogros2_monitor.gate', '--to', f'127.0.0.1:{to}',
         '--listen', '127.0.0.1:0', '--public', ':0', '--certificate', made.certificate,
         '--key', made.key, '--token-file', made.token, *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield Running(process, folder)
    finally:
        process.terminate()
        assert process.wait(60) == 0
        process.stdout.close()


UPGRADE = 'Upgrade: websocket\r\nConnection: close\r\n'


def ask(gate: Running, target: str, more: str = UPGRADE, at: str = '127.0.0.1') -> bytes:
    """Return the answer to a request over TLS, to one who knows the certificate."""
    tls = ssl.create_default_context(cafile=gate.certificate)
    with socket.create_connection((at, gate.ports[1]), timeout=20) as plain:
        with tls.wrap_socket(plain, server_hostname='planner') as connection:
            connection.sendall(request(target, more=more))
            return b''.join(iter(lambda: connection.recv(4096), b''))


def test_gate_answers_by_itself_and_logs_each_refusal_once(tmp_path, free_udp_port):
    with running(tmp_path, free_udp_port) as gate:
        for _ in range(3):
            assert ask(gate, '/').startswith(b'HTTP/1.1 401 ')
            assert ask(gate, '/?token=wrong').startswith(b'HTTP/1.1 401 ')
            with closing(socket.create_connection(
                    ('127.0.0.1', gate.ports[1]), timeout=20)) as plain:
                plain.sendall(request(f'/?token={gate.token}'))
                assert b'HTTP/1.1' not in plain.recv(4096)
        assert [gate.line() for _ in range(3)] == [
            'turned away 127.0.0.1: no token', 'turned away 127.0.0.1: a wrong token',
            'turned away 127.0.0.1: no TLS: HTTP_REQUEST']
        # nothing is the bridge
        assert ask(gate, f'/?token={gate.token}').startswith(b'HTTP/1.1 502 ')
        assert 'the bridge does not answer' in gate.line()
        assert ask(gate, f'/?token={gate.token}&x=' + 'x' * 40000).startswith(b'HTTP/1.1 431 ')
        assert ask(gate, f'/favicon.ico?token={gate.token}', more='').startswith(
            b'HTTP/1.1 404 ')
        children = Path(f'/proc/{os.getpid()}/task').glob('*/children')
        words = b' '.join(
            Path('/proc', child, 'cmdline').read_bytes()
            for path in children for child in path.read_text().split())
        assert b'monitor.gate' in words and gate.token.encode() not in words
        assert gate.line() == 'turned away 127.0.0.1: too long a request'
    assert gate.ended() == []


def test_other_networks_get_no_handshake(tmp_path, free_udp_port):
    words = '--allow', '127.0.0.2/32', '--allow', '::1/128'
    with running(tmp_path, free_udp_port, *words) as gate:
        for _ in range(3):
            with pytest.raises(OSError, match='reset|EOF|violation'):
                ask(gate, f'/?token={gate.token}')
        assert b' 502 ' in ask(gate, f'/?token={gate.token}', at='::1')
        assert gate.line() == 'turned away 127.0.0.1: not among the networks that are allowed'
        assert gate.line().startswith('turned away ::1: the bridge does not answer')
    assert gate.ended() == []
