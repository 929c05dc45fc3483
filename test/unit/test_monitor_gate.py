# SPDX-License-Identifier: Apache-2.0
"""The gate before the bridge: who gets through, who doesn't, and what is said of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
import http.server
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

from fogros2.monitor.gate import admitted, endpoint, Refused

TOKEN = 'sesame-0123456789'


def request(target: str, method: str = 'GET') -> bytes:
    return f'{method} {target} HTTP/1.1\r\nHost: x\r\n\r\n'.encode()


def test_the_token_is_taken_out_of_what_is_handed_on():
    assert admitted(request(f'/a?x=1&token={TOKEN}&y=%20'), TOKEN) == request('/a?x=1&y=+')
    assert admitted(request(f'/?token={TOKEN}'), TOKEN) == request('/')


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
])
def test_others_are_refused(head, status):
    with pytest.raises(Refused) as refused:
        admitted(head, TOKEN)
    assert refused.value.status.startswith(status)
    assert TOKEN not in str(refused.value)


def test_an_endpoint_is_an_address_and_a_port():
    assert endpoint('198.18.0.1:8765') == ('198.18.0.1', 8765)
    assert endpoint('[::1]:0') == ('::1', 0)
    for text in ('8765', 'here:', 'here:x', 'here:70000'):
        with pytest.raises(Exception, match='ADDRESS:PORT'):
            endpoint(text)


class Bridge(http.server.BaseHTTPRequestHandler):
    """Stands for the bridge: answers each GET with its target."""

    def do_GET(self):
        self.send_response(200)
        self.send_header('Content-Length', str(len(self.path)))
        self.end_headers()
        self.wfile.write(self.path.encode())

    def log_message(self, *_):
        pass


@pytest.fixture(scope='module')
def bridge() -> Iterator[int]:
    with http.server.ThreadingHTTPServer(('127.0.0.1', 0), Bridge) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


class Running:
    """A gate in a process of its own."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
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
        self._reader.join(20)
        return list(self._lines.queue)


@contextmanager
def running(folder: Path, to: int) -> Iterator[Running]:
    if shutil.which('openssl') is None:
        pytest.skip('needs openssl')
    subprocess.run(
        ['openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1',
         '-nodes', '-keyout', folder / 'key', '-out', folder / 'certificate', '-days', '1',
         '-subj', '/CN=test', '-addext', 'subjectAltName=IP:127.0.0.1'],
        check=True, capture_output=True)
    (folder / 'token').write_text(TOKEN + '\n')
    process = subprocess.Popen(
        [sys.executable, '-m', 'fogros2.monitor.gate', '--to', f'127.0.0.1:{to}',
         '--listen', '127.0.0.1:0', '--guarded', '127.0.0.1:0',
         '--certificate', folder / 'certificate', '--key', folder / 'key',
         '--token-file', folder / 'token'],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield Running(process)
    finally:
        process.terminate()
        assert process.wait(20) == 0
        process.stdout.close()


def ask(folder: Path, port: int, target: str) -> bytes:
    """Return the answer to a request over TLS, to one who knows the certificate."""
    tls = ssl.create_default_context(cafile=folder / 'certificate')
    with socket.create_connection(('127.0.0.1', port), timeout=20) as plain:
        with tls.wrap_socket(plain, server_hostname='127.0.0.1') as connection:
            connection.sendall(request(target)[:-2] + b'Connection: close\r\n\r\n')
            return b''.join(iter(lambda: connection.recv(4096), b''))


def test_who_may_comes_in_and_others_are_logged_once(tmp_path, bridge):
    with running(tmp_path, bridge) as gate:
        open_port, guarded = gate.ports
        with closing(socket.create_connection(('127.0.0.1', open_port), timeout=20)) as robot:
            robot.sendall(request('/robot'))
            assert b'200 OK' in robot.recv(4096)
        answer = ask(tmp_path, guarded, f'/?token={TOKEN}&topic=a')
        assert b' 200 OK' in answer
        assert answer.endswith(b'/?topic=a')
        for _ in range(3):
            assert ask(tmp_path, guarded, '/').startswith(b'HTTP/1.1 401 ')
            assert ask(tmp_path, guarded, '/?token=wrong').startswith(b'HTTP/1.1 401 ')
            with closing(socket.create_connection(('127.0.0.1', guarded), timeout=20)) as plain:
                plain.sendall(request(f'/?token={TOKEN}'))
                assert b'HTTP/1.1 200' not in plain.recv(4096)
        assert [gate.line() for _ in range(3)] == [
            'turned away 127.0.0.1: no token', 'turned away 127.0.0.1: a wrong token',
            'turned away 127.0.0.1: no TLS: HTTP_REQUEST']
    assert gate.ended() == []


def test_the_process_list_does_not_have_the_token(tmp_path, bridge):
    with running(tmp_path, bridge):
        children = Path(f'/proc/{os.getpid()}/task').glob('*/children')
        words = b' '.join(
            Path('/proc', child, 'cmdline').read_bytes()
            for path in children for child in path.read_text().split())
    assert b'monitor.gate' in words
    assert TOKEN.encode() not in words


def test_a_bridge_that_is_not_there_yet_is_told(tmp_path, free_udp_port):
    with running(tmp_path, free_udp_port) as gate:
        assert ask(tmp_path, gate.ports[1], f'/?token={TOKEN}').startswith(b'HTTP/1.1 502 ')
        assert 'the bridge does not answer' in gate.line()


def test_a_long_request_is_cut_off(tmp_path, bridge):
    with running(tmp_path, bridge) as gate:
        answer = ask(tmp_path, gate.ports[1], f'/?token={TOKEN}&x=' + 'x' * 40000)
        assert answer.startswith(b'HTTP/1.1 431 ')
